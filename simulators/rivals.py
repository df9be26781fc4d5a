"""Whether anyone could tell a hidden effect from every other one by the data at hand.

Each family of the simulator, at each of its places, is weighed against what the hidden effect shows without noise:

    ln E = 1/2 b' A^-1 b - 1/2 ln |A|,   A = I + G'G,  b = G's

with s what shows of the hidden effect and G what shows of the family's coefficients at their hard bounds, both in units
of the noise: effects are drawn by how large they show, so that the size that is plausible for either of two says
nothing about which of them it is. With noise, the odds of two families scatter by the length of the difference between
their fits. An effect is separable where the nearest rival is beaten by `MARGIN` in all but 2 % of the draws of the
noise, and plain where it is in all but 0.1 %. Places of the effect's own family are no rivals: what is asked is its
name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from simulators.effects.base import Effect
from simulators.effects.spec import LIBRARY
from simulators.scene import Scene
from simulators.screws import Floats
from simulators.visible import Visibility

MARGIN = 5.0  # of ln odds
_SIGMAS = 2.054  # a normal number is above minus this in 98 % of draws
_PLAIN_SIGMAS = 3.090  # likewise in 99.9 %
_STEP_TIMES = 9  # at which a rival may step
_LINEAR = 1e-2  # of a bound: small enough to be linear
# A free curve of the angle follows any other error of that joint's angle; its many coefficients are what speaks
# against it, and not the data. It is no rival.
_NO_RIVAL = ("joint_error_map",)


@dataclass(frozen=True)
class Separation:
    """How far a hidden effect stands from its nearest rival.

    Attributes:
        rival: `family@where`; empty where there is none.
        log_odds: expected, of the effect's family against the rival.
        scatter: standard deviation of these by the noise.
    """

    rival: str
    log_odds: float
    scatter: float

    @property
    def is_separable(self) -> bool:
        """Beaten in all but 2 % of the draws of the noise."""
        return self.log_odds - _SIGMAS * self.scatter >= MARGIN

    @property
    def is_plain(self) -> bool:
        """Beaten in all but 0.1 % of the draws of the noise."""
        return self.log_odds - _PLAIN_SIGMAS * self.scatter >= MARGIN


def nearest_rival(scene: Scene, visibility: Visibility, effect: Effect) -> Separation:
    """The family, other than the effect's own, that explains best what shows of it.

    Args:
        scene: the data.
        visibility: what shows of it.
        effect: the hidden one.
    """
    signal = visibility.seen(scene.shift_mm([effect])[:, :, None])[:, 0]
    own_evidence, own_fit = _weigh(_columns(scene, visibility, effect), signal)
    nearest = Separation("", float("inf"), 0.0)
    for rival in _rivals(scene, effect.family):
        evidence, fit = _weigh(_columns(scene, visibility, rival), signal)
        if own_evidence - evidence < nearest.log_odds:
            scatter = float(np.linalg.norm(own_fit - fit))
            nearest = Separation(f"{rival.family}@{rival.where}", own_evidence - evidence, scatter)
    return nearest


def _rivals(scene: Scene, family: str) -> Iterator[Effect]:
    draws = scene.draws
    for name, kind in LIBRARY.items():
        if name != family and name not in _NO_RIVAL:
            for where in draws.places(name):
                yield from _forms(kind(where=where).anchored(draws.first_s, draws.mean_degC), scene)


def _forms(effect: Effect, scene: Scene) -> Iterator[Effect]:
    """The variants of a family: cycles a turn, instants of a step."""
    if effect.family == "encoder_harmonic":
        yield from (_changed(effect, k=k) for k in (1, 2))
    elif "time_s" in {f.name for f in fields(effect)}:
        at = np.linspace(0.0, 1.0, _STEP_TIMES + 2)[1:-1]
        yield from (_changed(effect, time_s=float(t)) for t in np.quantile(scene.training.columns["time_s"], at))
    else:
        yield effect


def _columns(scene: Scene, visibility: Visibility, effect: Effect) -> Floats:
    """(3 n, k) what shows of each coefficient of an effect at its bound; none where it lacks a column."""
    bounds = scene.draws.bounds(effect)
    small = [{**dict.fromkeys(bounds, 0.0), name: _LINEAR * bound} for name, bound in bounds.items()]
    try:
        moved = [scene.shift_mm([_changed(effect, **size)]) for size in small]
    except ValueError:
        return np.zeros((3 * len(scene.training.prism), 0))
    return visibility.seen(np.stack(moved, axis=2) / _LINEAR)


def _changed(effect: Effect, **values: Any) -> Effect:
    return replace(effect, **values)


def _weigh(columns: Floats, signal: Floats) -> tuple[float, Floats]:
    """ln of the evidence, and (3 n,) the fit."""
    A = np.eye(columns.shape[1]) + columns.T @ columns
    b = columns.T @ signal
    found = np.linalg.solve(A, b)
    return 0.5 * float(b @ found) - 0.5 * float(np.linalg.slogdet(A)[1]), columns @ found
