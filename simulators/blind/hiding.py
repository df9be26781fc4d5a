"""Hiding effects of a chosen visible size in a scene of the benchmark or in a live rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.blind.effect_draws import Bounded, EffectDraws
from simulators.blind.scene import Scene
from simulators.blind.visibility import Visibility, reading_covariance_mm2
from simulators.effects.base import Effect
from simulators.effects.library import LIBRARY
from simulators.hydraulics import TEMPERATE_DEGC
from simulators.rig.dataset import prisms_mm, random_poses
from simulators.rig.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]

_CLOSE = 0.01  # tolerance as a share of the requested size
_TRIALS = 4

# For a live rig
SESSIONS_S = 900.0  # minimum duration of its sessions
SIZES = (1.0, 3.0)  # limits of the visible size of its effect
_POSES = 60
_DWELL_S = 3.5
_BEYOND = ("joint_error_map",)  # visible only with hundreds of poses


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that was hidden.

    Attributes:
        effect: the effect with its coefficients.
        size: visible size of its displacement, by the caller's measure.
        separable: False if the data cannot distinguish it from an effect or place that is not hidden.
    """

    effect: Effect
    size: float
    separable: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Return the effect as a dict for JSON."""
        return {
            "family": self.effect.family,
            "where": self.effect.where,
            "coefficients": {k: v for k, v in asdict(self.effect).items() if k != "where"},
            "visible_over_noise": round(self.size, 3),
        }


class UnreachableError(ValueError):
    """An effect cannot reach the requested visible size within its hard bounds, or has no place."""


def hide(
    scene: Scene,
    families: Sequence[str],
    size: float,
    visible: Callable[[Floats], float],
    seed: int,
    *,
    where: Sequence[str | None] = (),
) -> tuple[HiddenEffect, ...]:
    """Draw effects of a given visible size, at places where they are visible.

    Args:
        scene: the scene in which to hide them.
        families: families of the effects; the same family twice gets two places.
        size: visible size of each effect, measured by `visible`.
        visible: function that returns the visible size of a displacement, (n, 3) in mm, of the training fixes. It must
            grow with the displacement; the caller decides which part calibration would absorb.
        seed: the same seed draws the same effects.
        where: fixed place for each family; None for a random one.

    Raises:
        UnreachableError: the effect cannot reach this visible size within its hard bounds at any place.
        KeyError: a family is unknown.
    """
    rng = np.random.default_rng([seed, 42])
    hidden: list[HiddenEffect] = []
    for number, family in enumerate(families):
        fixed = where[number] if number < len(where) else None
        taken = {h.effect.where for h in hidden if h.effect.family == family}
        places = [p for p in scene.draws.places(family) if p not in taken and fixed in (None, p)]
        if not places:
            raise UnreachableError(f"{family}: this rig has no place for it" + (f" at {fixed}" if fixed else ""))
        for place in rng.permutation(places):
            found = _scaled_to(size, scene, scene.draws.draw(family, str(place), rng), visible)
            if found is not None:
                hidden.append(found)
                break
        else:
            raise UnreachableError(f"{family}: it reaches size {size:g} nowhere within its hard bounds")
    return tuple(hidden)


def _scaled_to(size: float, scene: Scene, drawn: Bounded, visible: Callable[[Floats], float]) -> HiddenEffect | None:
    """Return the effect scaled to the visible size `size`; None if that is beyond its bound."""
    factor = 1.0
    for _ in range(_TRIALS):
        effect = drawn.scaled(factor)
        seen = visible(scene.displacement_mm([effect]))
        if abs(seen - size) <= _CLOSE * size:
            return HiddenEffect(effect, seen)
        if seen <= 0.0 or (factor == drawn.most and seen < size):
            return None
        factor = min(factor * size / seen, drawn.most)
    return None


def draw_hidden_effect(truth: RigTruth, rng: np.random.Generator) -> HiddenEffect:
    """Draw an effect for a live rig that is visible in a session of static poses, within its hard bounds.

    Its size is the RMS of the displacement in units of a fix's noise, measured by `Visibility`.

    Args:
        truth: the machine without the effect.
        rng: random generator.

    Raises:
        ValueError: no effect is visible on this rig.
    """
    rig = truth.rig
    names = rig.prism_names
    drawn = random_poses(rig, _POSES, rng)
    prism = np.repeat(np.array(names), _POSES)
    joints = {name: np.tile(values, len(names)) for name, values in drawn.items()}
    columns = _standing_columns(truth, len(prism), rng)
    sigma = {j.name: np.full(len(prism), np.hypot(j.sigma, j.resolution / np.sqrt(12.0))) for j in rig.joints}
    station = (rig.station.distance_sigma_mm**2 + rig.station.target_sigma_mm**2) * np.eye(3)
    visible = Visibility(truth, prism, joints, reading_covariance_mm2(truth, prism, joints, sigma) + station)
    draws = EffectDraws(rig, names, 0.0, SESSIONS_S, TEMPERATE_DEGC)
    without_mm = prisms_mm(truth, prism, joints, columns)
    wanted = float(rng.uniform(*SIZES))
    for family in rng.permutation([name for name in LIBRARY if name not in _BEYOND]).tolist():
        for where in rng.permutation(np.array(draws.places(family), dtype=np.str_)).tolist():
            bounded = draws.draw(family, where, rng)
            try:
                with_mm = prisms_mm(replace_effects(truth, [bounded.effect]), prism, joints, columns)
            except ValueError:  # the family needs a column that a live rig does not measure
                break
            size = visible.size(with_mm - without_mm)
            if size > 0.0 and wanted / size <= bounded.most:
                return HiddenEffect(bounded.scaled(wanted / size), wanted)
    raise ValueError(f"no effect is visible on rig {rig.name!r} within its bounds")


def _standing_columns(truth: RigTruth, rows: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return the columns on which effects may depend, with values like in sessions of static poses."""
    joints = truth.rig.joints
    columns = {f"{joint.name}_dir": rng.choice([-1.0, 1.0], rows) for joint in joints}
    columns |= {f"{joint.name}_rate": np.zeros(rows) for joint in joints}
    columns["time_s"] = np.linspace(0.0, SESSIONS_S, rows)
    columns["dwell_s"] = np.full(rows, _DWELL_S)
    columns["temperature_degC"] = np.full(rows, TEMPERATE_DEGC)
    return columns
