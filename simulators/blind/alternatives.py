"""Separability of a hidden effect from all alternatives with the given data.

For each family of the simulator, at each of its places, the log evidence for the noise-free visible displacement of the
hidden effect is

    ln E = 1/2 b' A^-1 b - 1/2 ln |A|,   A = I + G'G,  b = G's

s is the visible displacement by the hidden effect, and G the visible displacement by the family's coefficients at their
hard bounds, both in units of the noise. The prior width is the hard bound and not the plausible size, because effects
are drawn by their visible size. With noise, the standard deviation of the log odds of two families is the norm of the
difference between their fits. An effect is separable if it beats the nearest alternative by `MARGIN` in all but 2 % of
the draws of the noise, and plain if it does so in all but 0.1 %. The effect's own family at other places is not an
alternative, because only the name matters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from simulators.blind.scene import Scene
from simulators.blind.visibility import Visibility
from simulators.effects.base import Effect
from simulators.effects.library import LIBRARY
from simulators.rig.screws import Floats

MARGIN = 5.0  # ln odds
SIGMAS = 2.054  # a standard normal number is above minus this in 98 % of draws
_PLAIN_SIGMAS = 3.090  # the same for 99.9 %
_STEP_TIMES = 9  # number of times at which an alternative may step
_LINEAR = 1e-2  # share of a bound that is small enough for a linear response
# A free curve of the angle can follow any other error of that joint's angle, and only its many coefficients count
# against it, not the data. It is therefore not an alternative.
_NO_ALTERNATIVE = ("joint_error_map",)


@dataclass(frozen=True)
class Separation:
    """Evidence for a hidden effect against its nearest alternative.

    Attributes:
        alternative: `family@where`; empty if the rig has no other effect.
        log_odds: expected log odds of the effect's family against the alternative.
        scatter: standard deviation of the log odds due to noise.
    """

    alternative: str
    log_odds: float
    scatter: float

    @property
    def is_separable(self) -> bool:
        """True if the alternative is beaten in all but 2 % of the draws of the noise."""
        return self.log_odds - SIGMAS * self.scatter >= MARGIN

    @property
    def is_plain(self) -> bool:
        """True if the alternative is beaten in all but 0.1 % of the draws of the noise."""
        return self.log_odds - _PLAIN_SIGMAS * self.scatter >= MARGIN


def nearest_alternative(scene: Scene, visibility: Visibility, effect: Effect) -> Separation:
    """Find the family, other than the effect's own, that best explains the effect's visible displacement.

    Args:
        scene: the data.
        visibility: visible part of displacements in the scene.
        effect: the hidden effect.
    """
    signal = visibility.seen(scene.displacement_mm([effect])[:, :, None])[:, 0]
    own_evidence, own_fit = weigh(effect_columns(scene, visibility, effect), signal)
    nearest = Separation("", float("inf"), 0.0)
    for alternative in _alternatives(scene, effect.family):
        evidence, fit = weigh(effect_columns(scene, visibility, alternative), signal)
        if own_evidence - evidence < nearest.log_odds:
            scatter = float(np.linalg.norm(own_fit - fit))
            nearest = Separation(f"{alternative.family}@{alternative.where}", own_evidence - evidence, scatter)
    return nearest


def _alternatives(scene: Scene, family: str) -> Iterator[Effect]:
    draws = scene.draws
    for name, kind in LIBRARY.items():
        if name != family and name not in _NO_ALTERNATIVE:
            for where in draws.places(name):
                yield from _forms(kind(where=where).anchored(draws.first_s, draws.mean_degC), scene)


def _forms(effect: Effect, scene: Scene) -> Iterator[Effect]:
    """Yield the variants of an effect: different cycles per turn, or different times of a step."""
    if effect.family == "encoder_harmonic":
        yield from (_changed(effect, k=k) for k in (1, 2))
    elif "time_s" in {f.name for f in fields(effect)}:
        at = np.linspace(0.0, 1.0, _STEP_TIMES + 2)[1:-1]
        yield from (_changed(effect, time_s=float(t)) for t in np.quantile(scene.training.columns["time_s"], at))
    else:
        yield effect


def effect_columns(scene: Scene, visibility: Visibility, effect: Effect) -> Floats:
    """Return the (3 n, k) visible displacement by each coefficient of an effect at its bound.

    The displacement is in units of the noise; k is 0 if the data lack a column that the effect needs.

    Args:
        scene: the data.
        visibility: visible part of displacements in the scene.
        effect: the effect, at its place.
    """
    return visibility.seen(effect_columns_mm(scene, effect))


def effect_columns_mm(scene: Scene, effect: Effect) -> Floats:
    """Return the (n, 3, k) displacement in mm by each coefficient of an effect at its bound.

    k is 0 if the data lack a column that the effect needs.
    """
    bounds = scene.draws.bounds(effect)
    small = [{**dict.fromkeys(bounds, 0.0), name: _LINEAR * bound} for name, bound in bounds.items()]
    try:
        moved = [scene.displacement_mm([_changed(effect, **size)]) for size in small]
    except ValueError:
        return np.zeros((len(scene.training.prism), 3, 0))
    return np.stack(moved, axis=2) / _LINEAR


def library_columns_mm(scene: Scene) -> list[tuple[Effect, Floats]]:
    """Return each variant of each library effect at all its places, with its columns in mm; without free curves."""
    draws = scene.draws
    return [
        (form, columns_mm)
        for name, kind in LIBRARY.items()
        if name not in _NO_ALTERNATIVE
        for where in draws.places(name)
        for form in _forms(kind(where=where).anchored(draws.first_s, draws.mean_degC), scene)
        if (columns_mm := effect_columns_mm(scene, form)).shape[2]
    ]


def _changed(effect: Effect, **values: Any) -> Effect:
    return replace(effect, **values)


def weigh(columns: Floats, signal: Floats) -> tuple[float, Floats]:
    """Return the log evidence and the (3 n,) fit.

    Args:
        columns: (3 n, k) visible displacement by each coefficient at its bound, in units of the noise.
        signal: (3 n,) visible displacement to explain, in units of the noise.
    """
    A = np.eye(columns.shape[1]) + columns.T @ columns
    b = columns.T @ signal
    found = np.linalg.solve(A, b)
    return 0.5 * float(b @ found) - 0.5 * float(np.linalg.slogdet(A)[1]), columns @ found
