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
_ROUNDING = 1e-3  # of a bound that was read in a message
_LEAST_LOAD = 0.05  # of the largest on any joint: less bends nothing


@dataclass(frozen=True)
class Bounded:
    """An effect at its plausible size, and the factor from there to its hard bound."""

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
        rig: the description; bounds follow from its own weights.
        prisms: that the data has.
        first_s, last_s: when it begins and ends.
        mean_degC: its mean temperature; effects of warmth count from it, as those of time count from `first_s`.
    """

    rig: Rig
    prisms: Sequence[str]
    first_s: float
    last_s: float
    mean_degC: float  # noqa: N815 - the unit is degC

    def places(self, family: str) -> tuple[str, ...]:
        """Places of an effect on the rig, empty if there are none; KeyError if there is no such family."""
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
            found.remove("station")  # the same as that of the only prism
        return tuple(found)

    def draw(self, family: str, where: str, rng: np.random.Generator) -> Bounded:
        """Draw an effect of plausible size at a place; KeyError if there is no such family."""
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
        """Largest load of the rig's own weights on a revolute joint in its work volume, N m."""
        return self._loads[joint]

    def bounds(self, effect: Effect) -> dict[str, float]:
        """Hard bound of each amplitude of an effect, at its place and in its direction."""
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
        """Return the most that each amplitude of an effect may be asked to be: its hard bound, or its usual size.

        A joint that carries next to nothing has the bounds of one that carries a little.
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
            usual_size: dict[str, Any] = {name: value / times for name, value in size.items()}  # bounds go by direction
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
        """Largest moment of the weights that a row carries in the work volume, N m."""
        if row not in self._moments:
            moments = self._nominal.row_moment(row, self._volume)
            self._moments[row] = float(np.linalg.norm(moments, axis=1).max())
        return self._moments[row]

    @cached_property
    def _moments(self) -> dict[int, float]:
        """Row -> largest moment, of those that were asked for."""
        return {}

    def _tip_mm(self, effects: Sequence[Effect]) -> Floats:
        tip = max(self.rig.prisms, key=lambda prism: prism.frame).name
        return replace_effects(self._nominal, effects).prism_mm(tip, self._volume)


def require_plausible(rig: Rig, effects: Sequence[Effect]) -> None:
    """Refuse effects beyond their hard bounds: no machine of the rig has them.

    Raises:
        ValueError: names the coefficient and its bound.
    """
    draws = EffectDraws(rig, rig.prism_names, 0.0, 0.0, 0.0)
    for effect in effects:
        effect.check(rig)
        for name, bound in draws.limits(effect).items():
            value = getattr(effect, name)
            if abs(value) > bound * (1.0 + _ROUNDING):
                raise ValueError(
                    f"{effect.family}@{effect.where}: {name}={value:g} is beyond {bound:.3g}, the most that such a "
                    "machine can have"
                )
