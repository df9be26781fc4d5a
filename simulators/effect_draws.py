"""Effects at random: somewhere that a rig has a place for them, with random signs and phases, within hard bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig
from simulators.dataset import random_poses
from simulators.effects.base import Effect
from simulators.effects.spec import FAMILIES
from simulators.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]

_VOLUME_POSES = 256
_LEAST_LOAD = 0.05  # of the largest on any joint: less bends nothing
_STEP_WITHIN = 0.25, 0.75  # of the time, where something jumps

# Hard limits of what is plausible, by coefficient. "At the largest load" stands for the rig's own weights.
_BOUNDS: Mapping[str, Mapping[str, float]] = {
    "pad_play": {"clearance_mm": 8.0},
    "backlash": {"width_rad": 5e-3},
    "gravity_flip_play": {"width_rad": 5e-3},
    "encoder_harmonic": {"cosk_rad": 6e-3, "sink_rad": 6e-3},
    "joint_error_map": {"rms_rad": 5e-3},
    "angle_scale": {"scale": 5e-3},
    "transducer_scale": {"scale": 1e-2},
    "transducer_quadratic": {"mm_per_m2": 20.0},
    "transducer_index_jump": {"jump_mm": 30.0},
    "transducer_cumulative": {"mm_per_m": 0.3},
    "thermal_expansion": {"per_K": 2.5e-5},
    "solar_bow": {"rad_per_K": 5e-4},
    "base_settlement": {"tilt_x_rad_per_h": 1e-3, "tilt_y_rad_per_h": 1e-3, "z_mm_per_h": 5.0},
    "base_step": {"tilt_x_rad": 5e-3, "tilt_y_rad": 5e-3, "z_mm": 20.0},
    "cylinder_compression": {"mm_per_bar": 0.1},
    "leak_down": {"rad_per_s": 5e-5},
    "latency": {"seconds": 0.3},
    "clock_drift": {"ppm": 50.0},
    "station_scale": {"ppm": 50.0},
    "prism_constant": {"mm": 40.0},
    "prism_incidence": {"cos1_mm": 8.0, "sin1_mm": 8.0},
    "linkage_coupling": {"coupling": 1e-2},
    "gear_mesh": {"cos_rad": 6e-3, "sin_rad": 6e-3},
    "cross_law": {"rad": 6e-3},
    "thermal_cross": {"rad_at_10K": 6e-3},
    "stick_slip_rate": {"rad": 6e-3},
    "valve_current_error": {"rad_at_rated": 6e-3},
    "prism_mast_bend": {"mm": 15.0},
}
_RAD_AT_THE_LARGEST_LOAD: Mapping[str, float] = {
    "joint_compliance": 20e-3,
    "payload_change": 20e-3,
    "load_hysteresis": 5e-3,
    "stiffening_compliance": 20e-3,
    "creep": 5e-3,
    "base_rocking": 5e-3,
}
_MM_AT_FULL_REACH: Mapping[str, float] = {"boom_droop": 300.0, "twist_by_reach": 100.0}
_EITHER_SIGN = (
    *("encoder_harmonic", "angle_scale", "linkage_coupling", "solar_bow"),
    *("transducer_scale", "transducer_quadratic", "transducer_index_jump", "transducer_cumulative"),
    *("base_settlement", "base_step", "clock_drift", "station_scale", "prism_constant", "prism_incidence"),
    *("gear_mesh", "cross_law", "thermal_cross", "valve_current_error"),
)
_BENEATH_A_LOAD = (
    *("joint_compliance", "payload_change", "load_hysteresis", "gravity_flip_play", "leak_down", "solar_bow"),
    *("stiffening_compliance", "creep"),
)


@dataclass(frozen=True)
class Bounded:
    """An effect at its plausible size, and how many times that its hard bound is."""

    effect: Effect
    most: float

    def scaled(self, factor: float) -> Effect:
        """The effect `factor` times as large."""
        return _resized(self.effect, {name: getattr(self.effect, name) * factor for name in self.effect.size})


@dataclass(frozen=True)
class EffectDraws:
    """What may be hidden in data of one machine.

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
        """Where an effect may be; empty where the rig has no place for it. KeyError: no such family."""
        kind, rig = FAMILIES[family], self.rig
        found = []
        for where in (*rig.joint_names, "boom", "base", "clock", "station", *self.prisms):
            try:
                kind(where=where).check(rig)
            except ValueError:
                continue
            if family not in _BENEATH_A_LOAD or self._carries(where):
                found.append(where)
        if family == "prism_constant" and len(self.prisms) == 1:
            found.remove("station")  # the same as that of the only prism
        return tuple(found)

    def draw(self, family: str, where: str, rng: np.random.Generator) -> Bounded:
        """An effect of plausible size at a place; KeyError: no such family."""
        effect = FAMILIES[family](where=where).anchored(self.first_s, self.mean_degC)
        effect = replace(effect, **_SHAPES.get(family, _no_shape)(self, effect, rng))
        size = {name: float(getattr(effect, name)) for name in effect.size}
        if len(size) > 1 and family in _EITHER_SIGN:
            direction = rng.normal(size=len(size))
            size = dict(zip(size, np.array(list(size.values())) * direction / np.linalg.norm(direction), strict=True))
        elif family in _EITHER_SIGN:
            size = {name: value * rng.choice([-1.0, 1.0]) for name, value in size.items()}
        effect = _resized(effect, {name: float(value) for name, value in size.items()})
        bounds = self.bounds(effect)
        return Bounded(effect, min(bounds[name] / abs(value) for name, value in size.items() if value != 0.0))

    def largest_load(self, joint: str) -> float:
        """Largest load of the rig's own weights on a revolute joint in its work volume, N m."""
        return self._loads[joint]

    def bounds(self, effect: Effect) -> dict[str, float]:
        """Hard bound of each coefficient that makes an effect large, at its place and of its direction."""
        family = effect.family
        if family in _BOUNDS:
            return dict(_BOUNDS[family])
        if family in _RAD_AT_THE_LARGEST_LOAD:
            load = max(self._loads.values()) if effect.where == "base" else self._loads[effect.where]
            return dict.fromkeys(effect.size, _RAD_AT_THE_LARGEST_LOAD[family] / load)
        size = {name: abs(float(getattr(effect, name))) for name in effect.size}
        small = _resized(effect, {name: 1e-3 * value for name, value in size.items()})
        moved_mm = self._tip_mm([small]) - self._tip_mm([])
        most = _MM_AT_FULL_REACH[family] / (1e3 * float(np.linalg.norm(moved_mm, axis=1).max()))
        return {name: value * most for name, value in size.items()}

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

    def _tip_mm(self, effects: Sequence[Effect]) -> Floats:
        tip = max(self.rig.prisms, key=lambda prism: prism.frame).name
        return replace_effects(self._nominal, effects).prism_mm(tip, self._volume)


def _resized(effect: Effect, size: Mapping[str, Any]) -> Effect:
    return replace(effect, **size)


Shape = Callable[[EffectDraws, Effect, np.random.Generator], dict[str, Any]]


def _no_shape(draws: EffectDraws, effect: Effect, rng: np.random.Generator) -> dict[str, Any]:
    del draws, effect, rng
    return {}


def _step_time(draws: EffectDraws, effect: Effect, rng: np.random.Generator) -> dict[str, Any]:
    del effect
    return {"time_s": draws.first_s + (draws.last_s - draws.first_s) * float(rng.uniform(*_STEP_WITHIN))}


def _harmonic(draws: EffectDraws, effect: Effect, rng: np.random.Generator) -> dict[str, Any]:
    del draws, effect
    return {"k": int(rng.integers(1, 3))}


def _curve(draws: EffectDraws, effect: Effect, rng: np.random.Generator) -> dict[str, Any]:
    """A smooth curve of some five swells over the joint's range, or two sharp lines that turn over in it."""
    low, high = draws.rig.joint(effect.where).limits
    once = 360.0 / min(high - low, 360.0)  # cycles a turn that make one cycle of the range
    return {
        "seed": int(rng.integers(1 << 31)),
        "length_deg": (high - low) * float(rng.uniform(0.06, 0.12)),
        "lines": int(rng.choice([0, 2])),
        "highest": max(6, round(8 * once)),
    }


def _knee(draws: EffectDraws, effect: Effect, rng: np.random.Generator) -> dict[str, Any]:
    return {"knee_Nm": draws.largest_load(effect.where) * float(rng.uniform(0.1, 0.3))}


_SHAPES: Mapping[str, Shape] = {
    "transducer_index_jump": _step_time,
    "base_step": _step_time,
    "encoder_harmonic": _harmonic,
    "joint_error_map": _curve,
    "stiffening_compliance": _knee,
}
