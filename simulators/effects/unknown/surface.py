"""Smooth random functions of two joints, without any part that depends on one of them alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Floats

LENGTH = 0.8  # correlation length, in units of half a joint's range
_TERMS = 2  # products of a curve of either joint
_WAVES = 40
_EVEN_POINTS = 81


@dataclass(frozen=True)
class PairSurface:
    """A sum of products of centred smooth curves of two joints; its RMS over their ranges is 1.

    As each curve has mean 0 over its joint's range, the mean over either joint is 0 at any value of the other: no error
    of a single joint's own angle describes a part of it.

    Attributes:
        first, second: names of the joints.
        seed: the same seed draws the same function.
    """

    first: str
    second: str
    seed: int

    def values(self, rig: Rig, read: Mapping[str, Floats]) -> Floats:
        """(n,) at readings, rad or mm."""
        rng = np.random.default_rng([self.seed, 73])
        even = np.linspace(-1.0, 1.0, _EVEN_POINTS)
        at = scaled_reading(rig, self.first, read), scaled_reading(rig, self.second, read)
        grid, out = np.zeros((_EVEN_POINTS, _EVEN_POINTS)), np.zeros(len(at[0]))
        for _ in range(_TERMS):
            (grid_first, first), (grid_second, second) = (_curve(rng, even, values) for values in at)
            grid += np.outer(grid_first, grid_second)
            out += first * second
        return out / float(np.sqrt(np.mean(grid**2)))


def draw_surface(rig: Rig, seed: int) -> PairSurface:
    """Return the function of two joints of a rig that a seed draws."""
    first, second = np.random.default_rng([seed, 72]).choice(np.array(rig.joint_names), 2, replace=False)
    return PairSurface(str(first), str(second), seed)


def scaled_reading(rig: Rig, joint: str, read: Mapping[str, Floats]) -> Floats:
    """(n,) readings of a joint, rad or mm, as -1 to 1 between its limits."""
    description = rig.joint(joint)
    low, high = np.deg2rad(description.limits) if description.kind == "revolute" else description.limits
    scaled: Floats = 2.0 * (read[joint] - low) / (high - low) - 1.0
    return scaled


def _curve(rng: np.random.Generator, even: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Draw a curve of Gaussian correlation; returns its values at even points and at others, about its mean."""
    cycles, phase = rng.normal(0.0, 1.0 / LENGTH, _WAVES), rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    on_even, values = (np.cos(np.outer(points, cycles) + phase).sum(axis=1) for points in (even, at))
    return on_even - on_even.mean(), values - on_even.mean()
