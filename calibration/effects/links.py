"""Links that deflect under their load: pivots of rows, the moments of the weights there, and effects of these."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import Carried, EffectContext
from calibration.effects.load_shapes import (
    UNIT,
    LoadShapes,
    UncertainLoadFamily,
    load_columns,
    load_variants,
    part_coefficients,
    part_names,
    shapes_by_design,
)
from calibration.kinematics.chain import Op
from calibration.kinematics.torques import MASS_SIGMA
from calibration.observations import Floats
from calibration.rig.description import Rig

_LINEAR = "compliance_rad_per_Nm"
_SIGMA_RAD = 1e-3  # at the largest moment of the weights beyond
_BOUND_RAD = 20e-3
_LEAST_NM = 1e-6
_LEAST_SHARE = 0.01  # smallest share of the largest moment for which the deflection of a link is visible


@dataclass(frozen=True)
class Link(Carried):
    """A row whose `theta` is driven, and the weights that turn with it."""

    @property
    def axis(self) -> Floats:
        """(n, 3) unit vectors of the axis about which the row turns, in the base frame."""
        return self._turning[0]

    @property
    def place_mm(self) -> Floats:
        """(n, 3) position of the pivot: the origin of the frame of the rotation, in the base frame."""
        return self._turning[1]

    @cached_property
    def moment_newton_m(self) -> Floats:
        """(n, 3) moment about the pivot of all weights beyond it."""
        moment: Floats = self._by_point.sum(axis=1)
        return moment

    @cached_property
    def parts_newton_m(self) -> Floats:
        """(n, 3, parts) changes of that moment if a mass, or its centre's distance, is larger by `MASS_SIGMA`."""
        loads, rig = self.context.loads, self.context.rig
        origins_mm = self.context.located.frames_mm[:, loads.point_frame]
        at_origins = self._moments(origins_mm)
        parts = []
        for index, mass in enumerate(rig.masses):
            own = self.hanging & (loads.point_mass == index)
            if mass.kg > 0.0 and own.any():
                parts.append(MASS_SIGMA * self._by_point[:, own].sum(axis=1))
                if mass.centre_mm is not None and any(mass.centre_mm):
                    parts.append(parts[-1] - MASS_SIGMA * at_origins[:, own].sum(axis=1))
        return np.stack(parts, axis=2) if parts else np.zeros((len(self.context), 3, 0))

    @cached_property
    def _by_point(self) -> Floats:
        return self._moments(self.weights[0])

    def _moments(self, places_mm: Floats) -> Floats:
        """Return the moments (n, points, 3) of the weights beyond the pivot if placed at positions (n, points, 3)."""
        newton = self.weights[1] * self.hanging
        arm_mm = places_mm - self.place_mm[:, None]
        moments: Floats = np.cross(arm_mm * (newton[:, :, None] / 1e3), self.context.down[:, None])
        return moments

    @cached_property
    def _turning(self) -> tuple[Floats, Floats]:
        """Axis and pivot, by following the chain up to the row's rotation."""
        chain, x, readings = self.context.chain, self.context.x, self.context.data.readings
        axes = np.tile(np.eye(3), (len(readings), 1, 1))
        place_mm = np.zeros((len(readings), 3))
        *before, own = chain.rig.path(self.row)
        for op in [op for number in before for op in chain.row_ops[number - 1]] + _up_to_turn(chain.row_ops[own - 1]):
            size = op.driven(readings) + (x[op.parameter] if op.parameter >= 0 else 0.0)
            if op.rotates:
                first, second = (op.axis + 1) % 3, (op.axis + 2) % 3
                u, v = axes[:, :, first].copy(), axes[:, :, second].copy()
                c, s = np.cos(size)[:, None], np.sin(size)[:, None]
                axes[:, :, first], axes[:, :, second] = c * u + s * v, c * v - s * u
            else:
                place_mm += size[:, None] * axes[:, :, op.axis]
        return axes[:, :, _turn(chain.row_ops[own - 1]).axis], place_mm


def _turn(ops: list[Op]) -> Op:
    """Return the rotation of a row that is driven by joints."""
    return next(op for op in ops if op.rotates and op.drive)


def _up_to_turn(ops: list[Op]) -> list[Op]:
    return ops[: ops.index(_turn(ops))]


class LinkFamily(UncertainLoadFamily, PrismFamily):
    """A link that turns slightly about its row's pivot, in proportion to a component of the weights' moment.

    All parts beyond the link move with it as a rigid body. The plausible compliance is derived from the largest moment
    of all weights beyond the pivot, whichever component deflects the link.
    """

    load_kind = "weights"

    @abstractmethod
    def row(self, rig: Rig, where: str) -> int:
        """Return the number of the row that turns."""

    @abstractmethod
    def deflecting_moment(self, axis: Floats, moments: Floats) -> Floats:
        """Return the component (n, 3, k) of the moments that deflects a link.

        Args:
            axis: (n, 3) unit vectors of the axis about which the link's row turns.
            moments: (n, 3, k) moments about the row's pivot.
        """

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        link = Link(context, self.row(context.rig, where))
        most, volume = _greatest(context, link.row), Link(context.work_volume, link.row)
        if most == 0.0 or not link.carries_prism.any() or np.abs(self._loads(volume)).max() < _LEAST_SHARE * most:
            return ()
        return load_variants(self.shapes(context, where), _SIGMA_RAD / most)

    def names(self, settings: Settings) -> tuple[str, ...]:
        return (_LINEAR, *part_names(settings))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        most = max(_greatest(context, self.row(context.rig, where)), _LEAST_NM)
        bound = _BOUND_RAD / most
        return (Coefficient(_LINEAR, UNIT, _SIGMA_RAD / most, 0.0, bound), *part_coefficients(settings, bound))

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        link, n = Link(context, self.row(context.rig, where)), len(context)
        if not context.rig.masses:
            return np.zeros((n, 3, len(self.names(settings))))
        loads = load_columns(
            self._loads(link), settings, lambda: self.shapes(context, where), lambda: self._parts(link)
        )
        turns = loads.reshape(n, 3, -1).transpose(0, 2, 1)
        arm_mm = (context.located.prism_mm - link.place_mm) * link.carries_prism[:, None]
        return context.to_station(np.cross(turns, arm_mm[:, None]).transpose(0, 2, 1))

    def _loads(self, link: Link) -> Floats:
        """Return the moment (3 n,) that deflects a link, N m, ordered by row and coordinate."""
        return self.deflecting_moment(link.axis, link.moment_newton_m[:, :, None]).reshape(-1)

    def _parts(self, link: Link) -> Floats:
        """Return the changes (3 n, parts) of `_loads` due to the uncertain parts of the weights."""
        parts = self.deflecting_moment(link.axis, link.parts_newton_m)
        return parts.reshape(-1, parts.shape[2])

    def shapes(self, context: EffectContext, where: str) -> LoadShapes:
        """Return the shapes of the load's uncertainty due to uncertain weights."""

        def in_volume(volume: EffectContext) -> tuple[Floats, Floats]:
            link = Link(volume, self.row(volume.rig, where))
            return self._loads(link), self._parts(link)

        return shapes_by_design(context, f"{self.name} {where}", in_volume, constant=True)


def _greatest(context: EffectContext, row: int) -> float:
    """Return the largest moment of the weights beyond a row in the work volume, N m; 0 without masses."""
    if not context.rig.masses:
        return 0.0
    if row not in context.greatest_moments:
        most = float(np.linalg.norm(Link(context.work_volume, row).moment_newton_m, axis=1).max(initial=0.0))
        context.greatest_moments[row] = most if most > _LEAST_NM else 0.0
    return context.greatest_moments[row]


def own_rows(rig: Rig) -> dict[str, int]:
    """Return joint name -> number of the first row that the joint turns, for revolute joints that turn a row."""
    found: dict[str, int] = {}
    for number, driven, name, _ in rig.couplings():
        if driven == "theta" and rig.joint(name).kind == "revolute":
            found.setdefault(name, number)
    return found


def turning_rows(rig: Rig) -> tuple[int, ...]:
    """Return the numbers of the rows that joints turn."""
    return tuple(number for number, row in enumerate(rig.rows, 1) if "theta" in row.drive)
