"""Intervals that hold 90 % of what is measured, whatever the shape of the errors (split conformal prediction).

A formal standard deviation, propagated from noise and covariances, says how errors compare between predictions. How
many of them an error may be is counted on rows that the model was fitted without (Papadopoulos et al. 2002; Lei et al.
2018), along each axis by itself: what gravity does to a boom is in one of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtri

from calibration.observations import Floats

LEVEL = 0.9
NORMAL = float(ndtri((1.0 + LEVEL) / 2.0))  # standard deviations that hold a normal error
_NORMAL_RADIUS = float(np.sqrt(chdtri(3, 1.0 - LEVEL) / 3.0))


@dataclass(frozen=True)
class Coverage:
    """Share of errors inside their intervals.

    Attributes:
        axes: of x, y and z.
        radius: of the balls.
    """

    axes: tuple[float, ...]
    radius: float

    def as_dict(self) -> dict[str, object]:
        """Object in the JSON of `calibrate` and `evaluate`."""
        return {"level": LEVEL, "axis_coverage": list(self.axes), "radius_coverage": self.radius}


@dataclass(frozen=True)
class Intervals:
    """Number of formal standard deviations that hold an error with probability `LEVEL`.

    Attributes:
        axes: of the error along x, y, z of the station's frame.
        radius: of its 3-D norm, in units of the root of the three variances' sum.
    """

    axes: tuple[float, float, float] = (NORMAL,) * 3
    radius: float = _NORMAL_RADIUS

    def at_other_setups(self) -> Intervals:
        """Intervals where nobody knows which way x and y point, seen from the machine; z is up at all set-ups."""
        level = float(np.sqrt((self.axes[0] ** 2 + self.axes[1] ** 2) / 2.0))
        return Intervals((level, level, self.axes[2]), self.radius)

    def or_wider(self, other: Intervals) -> Intervals:
        """Intervals that are, along each axis and for the norm, the wider of two."""
        x, y, z = np.maximum(self.axes, other.axes).tolist()
        return Intervals((x, y, z), max(self.radius, other.radius))

    def half_mm(self, formal_mm: Floats) -> Floats:
        """Half widths (n, 3) of the intervals of x, y and z, given formal standard deviations (n, 3)."""
        half_mm: Floats = formal_mm * np.array(self.axes)
        return half_mm

    def radius_mm(self, formal_mm: Floats) -> Floats:
        """Radii (n,) of the balls, given formal standard deviations (n, 3)."""
        radius_mm: Floats = self.radius * np.linalg.norm(formal_mm, axis=1)
        return radius_mm


@dataclass(frozen=True)
class StageIntervals:
    """Intervals of a model with a residual learner, and of its stage before, which hold where the learner is not used.

    What was counted where a learner is used says nothing of where it is not.

    Attributes:
        hybrid: of the model with its learner; the same as below where it has none.
        effects: of kinematics and effects alone.
    """

    hybrid: Intervals = Intervals()
    effects: Intervals = Intervals()

    def at_other_setups(self) -> StageIntervals:
        """Intervals where nobody knows which way x and y point, seen from the machine."""
        return StageIntervals(self.hybrid.at_other_setups(), self.effects.at_other_setups())

    def or_wider(self, other: Intervals) -> StageIntervals:
        """Intervals that are, at each stage, the wider of these and another."""
        return StageIntervals(self.hybrid.or_wider(other), self.effects.or_wider(other))

    def half_mm(self, formal_mm: Floats, weight: Floats | None) -> Floats:
        """Half widths (n, 3) of the intervals of x, y and z.

        Args:
            formal_mm: (n, 3) formal standard deviations.
            weight: (n,) of the learner in each row, 0 to 1; None for a model that has none.
        """
        if weight is None:
            return self.effects.half_mm(formal_mm)
        used, unused = self.hybrid.half_mm(formal_mm), self.effects.half_mm(formal_mm)
        return weight[:, None] * used + (1.0 - weight)[:, None] * unused

    def radius_mm(self, formal_mm: Floats, weight: Floats | None) -> Floats:
        """Radii (n,) of the balls; arguments are those of `half_mm`."""
        if weight is None:
            return self.effects.radius_mm(formal_mm)
        used, unused = self.hybrid.radius_mm(formal_mm), self.effects.radius_mm(formal_mm)
        return weight * used + (1.0 - weight) * unused


def coverage(error_mm: Floats, half_mm: Floats, radius_mm: Floats) -> Coverage:
    """Share of errors (n, 3) inside intervals of these half widths (n, 3) and inside balls of these radii (n,)."""
    axes = (np.abs(error_mm) <= half_mm).mean(axis=0)
    radius = (np.linalg.norm(error_mm, axis=1) <= radius_mm).mean()
    return Coverage(tuple(axes.tolist()), float(radius))


def conformal_intervals(error_mm: Floats, formal_mm: Floats, independent: int) -> Intervals:
    """Count the formal standard deviations that hold held-out errors.

    Args:
        error_mm: (n, 3) errors of rows that the model was fitted without, in the station's frame.
        formal_mm: (n, 3) their formal standard deviations.
        independent: how many of the rows are independent of each other; a new one exceeds the largest of m with
            probability 1 / (m + 1), so few of them make the intervals wider.
    """
    scaled = np.abs(error_mm) / formal_mm
    norm = np.linalg.norm(error_mm, axis=1) / np.linalg.norm(formal_mm, axis=1)
    share = min(1.0, LEVEL * (1.0 + 1.0 / independent))
    x, y, z = np.quantile(scaled, share, axis=0).tolist()
    return Intervals((x, y, z), float(np.quantile(norm, share)))
