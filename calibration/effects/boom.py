"""The telescoping boom of a machine: the first row that slides and is swung, and the parts that it carries."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import PrismFamily
from calibration.effects.context import Carried, EffectContext
from calibration.kinematics.chain import Chain, rotation_about
from calibration.observations import Floats
from calibration.rig.description import Rig

_LEAST_MM = 1e-6
_PARALLEL = math.cos(math.radians(1.0))  # a joint does not swing a slide if its axis is closer to the slide direction


def boom_of(rig: Rig) -> tuple[int, str] | None:
    """Return the number of the boom's row and the joint that extends it; None where a rig has no boom.

    A boom slides along `a` or `d`, and an earlier joint swings it about an axis that is not parallel to it. Of several,
    the first one is returned, as it carries the others.
    """
    chain = Chain(rig, {})
    return next((found for number in range(1, len(rig.rows) + 1) if (found := _swung(chain, number))), None)


def _swung(chain: Chain, number: int) -> tuple[int, str] | None:
    """Return a row and the joint that slides it if another joint swings it, otherwise None.

    Evaluated with all readings at zero: if all axes are parallel to the slide there, they are in every pose.
    """
    turned, axes = np.eye(3), np.empty((0, 3))
    for row in chain.rig.path(number):
        for op in chain.row_ops[row - 1]:
            along = turned[:, op.axis]
            if op.rotates:
                axes = np.vstack([axes, along]) if op.drive else axes
                turned = turned @ rotation_about(op.axis, op.constant)
            elif op.drive and row == number and (np.abs(axes @ along) < _PARALLEL).any():
                return number, chain.rig.joint_names[op.drive[0][0]]
    return None


class BoomFamily(PrismFamily):
    """An effect of the load on a telescoping boom; it has no place on rigs without a boom."""

    load_kind = "weights"

    def places(self, rig: Rig) -> tuple[str, ...]:
        return ("boom",) if boom_of(rig) is not None else ()

    def needs(self, where: str) -> str:
        del where
        return "masses in the rig file"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        del where
        return np.full(len(context), bool(context.rig.masses))


@dataclass(frozen=True)
class Boom(Carried):
    """The boom, and the parts that its tip carries.

    Attributes:
        context: n rows of observations.
        row: number of the boom's row. The boom's root is the origin of the preceding frame, its tip that of its own.
        joint: name of the joint that extends the boom.
    """

    joint: str

    @cached_property
    def root(self) -> int:
        """Number of the frame whose origin is the root."""
        path = self.context.rig.path(self.row)
        return path[-2] if len(path) > 1 else 0

    @cached_property
    def outer_mm(self) -> float:
        """Length of the outer section: the boom's length at a reading of zero."""
        row = self.context.rig.rows[self.row - 1]
        return abs(row.a_mm if self.joint in row.drive.get("a", {}) else row.d_mm)

    @cached_property
    def root_mm(self) -> Floats:
        """(n, 3) position of the root."""
        return self.context.located.frames_mm[:, self.root]

    @cached_property
    def tip_mm(self) -> Floats:
        """(n, 3) position of the tip."""
        return self.context.located.frames_mm[:, self.row]

    @cached_property
    def length_mm(self) -> Floats:
        """(n,) distance from root to tip."""
        length: Floats = np.sqrt(((self.tip_mm - self.root_mm) ** 2).sum(axis=1))
        return length

    @cached_property
    def axis(self) -> Floats:
        """(n, 3) unit vectors from root to tip; zero where the length is zero."""
        return (self.tip_mm - self.root_mm) / np.maximum(self.length_mm, _LEAST_MM)[:, None]

    @property
    def down(self) -> Floats:
        """(n, 3) unit vectors of gravity."""
        return self.context.down

    def lowered(self, arm: Floats) -> Floats:
        """Return the displacement (n, 3) of a point at `arm` (n, 3) as the boom turns down about its level axis.

        It is per rad and multiplied by the cosine of the boom's elevation: (axis x down) x arm.
        """
        along, below = (self.axis * arm).sum(axis=1), (self.down * arm).sum(axis=1)
        moved: Floats = along[:, None] * self.down - below[:, None] * self.axis
        return moved

    @cached_property
    def own(self) -> NDArray[np.bool_]:
        """(points,) mask of the point weights that are fixed to the boom's root section."""
        own: NDArray[np.bool_] = self.context.loads.point_frame == self.root
        return own


def boom_in(context: EffectContext) -> Boom | None:
    """Return the boom of a context's machine; None if it has none."""
    found = boom_of(context.rig)
    return None if found is None else Boom(context, *found)
