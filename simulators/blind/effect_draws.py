"""Random effects: places on a rig, signs and phases within hard bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.effects.base import Effect
from simulators.effects.library import FAMILIES
from simulators.rig.dataset import random_poses
from simulators.rig.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]

_VOLUME_POSES = 256
_ROUNDING = 1e-3  # relative tolerance, as a bound copied from a message is rounded
_LEAST_LOAD = 0.05  # share of the largest load on any joint; a smaller load bends nothing


@dataclass(frozen=True)
class Bounded:
    """An effect at its plausible size, and the factor from this size to its hard bound."""

    effect: Effect
    most: float

    def scaled(self, factor: float) -> Effect:
        """Return the effect `factor` times as large."""
        scaled: dict[str, Any] = {name: getattr(self.effect, name) * factor for name in self.effect.amplitudes}
        return replace(self.effect, **scaled)


@dataclass(frozen=True)
class EffectDraws:
    """Random effects for data of one machine.

    Attributes:
        rig: description of the rig; bounds follow from its weights.
        prisms: names of the prisms in the data.
        first_s, last_s: start and end of the data.
        mean_degC: mean temperature of the data; temperature effects count from it, and time effects from `first_s`.
    """

    rig: Rig
    prisms: Sequence[str]
    first_s: float
    last_s: float
    mean_degC: float  # noqa: N815 - the unit is degC

    def places(self, family: str) -> tuple[str, ...]:
        """Return the places of a family on the rig, empty if there are none; KeyError if the family is unknown."""
        kind, rig = FAMILIES[family], self.rig
        found = []
        rows = (f"row{number}" for number in range(1, len(rig.rows) + 1))
        for where in (*rig.joint_names, "boom", "base", "clock", "station", *self.prisms, *rows):
            try:
                kind(where=where).check(rig)
            except ValueError:
                continue
            if not kind.needs_load or self._carries(where):
                found.append(where)
        if family == "prism_constant" and len(self.prisms) == 1:
            found.remove("station")  # identical to the effect at the only prism
        return tuple(found)

    def draw(self, family: str, where: str, rng: np.random.Generator) -> Bounded:
        """Draw an effect of plausible size at a place; KeyError if the family is unknown."""
        effect = FAMILIES[family](where=where).anchored(self.first_s, self.mean_degC).draw_shape(self, rng)
        size: dict[str, Any] = {name: float(getattr(effect, name)) for name in effect.amplitudes}
        if effect.has_either_sign and len(size) > 1:
            direction = rng.normal(size=len(size))
            scaled = np.array(list(size.values())) * direction / np.linalg.norm(direction)
            size = dict(zip(size, scaled.tolist(), strict=True))
        elif effect.has_either_sign:
            size = {name: float(value * rng.choice([-1.0, 1.0])) for name, value in size.items()}
        effect = replace(effect, **size)
        bounds = self.bounds(effect)
        return Bounded(effect, min(bounds[name] / abs(value) for name, value in size.items() if value != 0.0))

    def largest_load(self, joint: str) -> float:
        """Return the largest load of the rig's own weights on a revolute joint in the work volume, N m."""
        return self._loads[joint]

    def bounds(self, effect: Effect) -> dict[str, float]:
        """Return the hard bound of each amplitude of an effect, at its place and in its direction."""
        bounds = effect.amplitudes
        if effect.bounded_at == "coefficient":
            return dict(bounds)
        if effect.bounded_at == "largest_load":
            load = max(self._loads.values()) if effect.where == "base" else self._loads[effect.where]
            return {name: bound / load for name, bound in bounds.items()}
        if effect.bounded_at == "largest_moment":
            moment = self._largest_moment(effect.moment_row(self.rig))
            return {name: bound / moment for name, bound in bounds.items()}
        size = {name: abs(float(getattr(effect, name))) for name in bounds}
        small: dict[str, Any] = {name: 1e-3 * value for name, value in size.items()}
        moved_mm = self._tip_mm([replace(effect, **small)]) - self._tip_mm([])
        largest_mm = 1e3 * float(np.linalg.norm(moved_mm, axis=1).max())
        return {name: value * (bounds[name] / largest_mm) for name, value in size.items()}

    def limits(self, effect: Effect) -> dict[str, float]:
        """Return the largest permitted value of each amplitude of an effect: its hard bound or its usual size.

        A joint with almost no load has the bounds of a joint with a small load.
        """
        size = {name: abs(float(getattr(effect, name))) for name in effect.amplitudes}
        usual = {name: abs(float(getattr(type(effect)(where=effect.where), name))) for name in size}
        times = max(size[name] / usual[name] for name in size)
        if times == 0.0:
            return {}
        if effect.bounded_at == "largest_load" and not self._carries(effect.where) and effect.where != "base":
            load = _LEAST_LOAD * max(self._loads.values())
            bounds = {name: bound / load for name, bound in effect.amplitudes.items()} if load else {}
        else:
            # Bounds depend on the direction
            usual_size: dict[str, Any] = {name: value / times for name, value in size.items()}
            bounds = self.bounds(replace(effect, **usual_size))
        return {name: max(bound, usual[name]) for name, bound in bounds.items()}

    def _carries(self, where: str) -> bool:
        return self._loads.get(where, 0.0) >= _LEAST_LOAD * max(self._loads.values(), default=0.0) > 0.0

    @cached_property
    def _nominal(self) -> RigTruth:
        return RigTruth(self.rig, 0, perturbation=0.0)

    @cached_property
    def _volume(self) -> dict[str, Floats]:
        return random_poses(self.rig, _VOLUME_POSES, np.random.default_rng([0, 41]))

    @cached_property
    def _loads(self) -> dict[str, float]:
        """Largest load on each revolute joint in the work volume, N m."""
        return {
            j.name: float(np.abs(self._nominal.gravity_load(j.name, self._volume)).max())
            for j in self.rig.joints
            if j.kind == "revolute"
        }

    def _largest_moment(self, row: int) -> float:
        """Return the largest moment of the weights that a row carries in the work volume, N m."""
        if row not in self._moments:
            moments = self._nominal.row_moment(row, self._volume)
            self._moments[row] = float(np.linalg.norm(moments, axis=1).max())
        return self._moments[row]

    @cached_property
    def _moments(self) -> dict[int, float]:
        """Cache: row -> largest moment."""
        return {}

    def _tip_mm(self, effects: Sequence[Effect]) -> Floats:
        tip = max(self.rig.prisms, key=lambda prism: prism.frame).name
        return replace_effects(self._nominal, effects).prism_mm(tip, self._volume)


def require_plausible(rig: Rig, effects: Sequence[Effect]) -> None:
    """Refuse effects beyond their hard bounds, which no machine of this type can have.

    Raises:
        ValueError: an effect is refused; the message names the coefficient and its bound.
    """
    draws = EffectDraws(rig, rig.prism_names, 0.0, 0.0, 0.0)
    for effect in effects:
        effect.check(rig)
        for name, bound in draws.limits(effect).items():
            value = getattr(effect, name)
            if abs(value) > bound * (1.0 + _ROUNDING):
                raise ValueError(
                    f"{effect.family}@{effect.where}: {name}={value:g} is beyond {bound:.3g}, the largest value that "
                    "such a machine can have"
                )
