"""Intervals that contain 90 % of measurements, whatever the distribution of errors (split conformal prediction).

Formal standard deviations, propagated from noise and covariances, give the relative size of the errors of predictions.
The number of standard deviations that an error may reach is calibrated on rows that were held out of the model's fit
(Papadopoulos et al. 2002; Lei et al. 2018), separately for each axis, because gravity bends a boom along one of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtri

from calibration.observations import Floats

LEVEL = 0.9
NORMAL = float(ndtri((1.0 + LEVEL) / 2.0))  # standard deviations that contain a normal error with probability LEVEL
_NORMAL_RADIUS = float(np.sqrt(chdtri(3, 1.0 - LEVEL) / 3.0))


@dataclass(frozen=True)
class Coverage:
    """Share of errors inside their intervals.

    Attributes:
        axes: shares for x, y and z.
        radius: share inside the balls.
    """

    axes: tuple[float, ...]
    radius: float

    def as_dict(self) -> dict[str, object]:
        """Return the object in the JSON of `calibrate` and `evaluate`."""
        return {"level": LEVEL, "axis_coverage": list(self.axes), "radius_coverage": self.radius}


@dataclass(frozen=True)
class Intervals:
    """Number of formal standard deviations that contain an error with probability `LEVEL`.

    Attributes:
        axes: for the error along x, y, z of the station's frame.
        radius: for its 3-D norm, in units of the square root of the sum of the three variances.
    """

    axes: tuple[float, float, float] = (NORMAL,) * 3
    radius: float = _NORMAL_RADIUS

    def at_other_setups(self) -> Intervals:
        """Return intervals for set-ups with x and y in any direction as seen from the machine; z is always up."""
        level = float(np.sqrt((self.axes[0] ** 2 + self.axes[1] ** 2) / 2.0))
        return Intervals((level, level, self.axes[2]), self.radius)

    def or_wider(self, other: Intervals) -> Intervals:
        """Return the wider of two intervals, separately for each axis and for the norm."""
        x, y, z = np.maximum(self.axes, other.axes).tolist()
        return Intervals((x, y, z), max(self.radius, other.radius))

    def half_mm(self, formal_mm: Floats) -> Floats:
        """Return half widths (n, 3) of the intervals of x, y, z for formal standard deviations (n, 3), all in mm."""
        half_mm: Floats = formal_mm * np.array(self.axes)
        return half_mm

    def radius_mm(self, formal_mm: Floats) -> Floats:
        """Return radii (n,) of the balls for formal standard deviations (n, 3), all in mm."""
        radius_mm: Floats = self.radius * np.linalg.norm(formal_mm, axis=1)
        return radius_mm


@dataclass(frozen=True)
class StageIntervals:
    """Intervals of a model with a residual learner, and without it for rows where the learner is not used.

    Intervals that were calibrated with a learner are not valid where the learner is not used.

    Attributes:
        hybrid: intervals of the model with its learner; equal to `effects` if it has none.
        effects: intervals of kinematics and effects alone.
    """

    hybrid: Intervals = Intervals()
    effects: Intervals = Intervals()

    def at_other_setups(self) -> StageIntervals:
        """Return intervals for set-ups with x and y in any direction as seen from the machine."""
        return StageIntervals(self.hybrid.at_other_setups(), self.effects.at_other_setups())

    def or_wider(self, other: Intervals) -> StageIntervals:
        """Return the wider of these intervals and another, separately for each stage."""
        return StageIntervals(self.hybrid.or_wider(other), self.effects.or_wider(other))

    def half_mm(self, formal_mm: Floats, weight: Floats | None) -> Floats:
        """Return half widths (n, 3) of the intervals of x, y and z, mm.

        Args:
            formal_mm: (n, 3) formal standard deviations.
            weight: (n,) weight of the learner in each row, 0 to 1; None for a model without a learner.
        """
        if weight is None:
            return self.effects.half_mm(formal_mm)
        used, unused = self.hybrid.half_mm(formal_mm), self.effects.half_mm(formal_mm)
        return weight[:, None] * used + (1.0 - weight)[:, None] * unused

    def radius_mm(self, formal_mm: Floats, weight: Floats | None) -> Floats:
        """Return radii (n,) of the balls, mm; arguments as `half_mm`."""
        if weight is None:
            return self.effects.radius_mm(formal_mm)
        used, unused = self.hybrid.radius_mm(formal_mm), self.effects.radius_mm(formal_mm)
        return weight * used + (1.0 - weight) * unused


def coverage(error_mm: Floats, half_mm: Floats, radius_mm: Floats) -> Coverage:
    """Return the share of errors (n, 3) inside intervals of half widths (n, 3) and inside balls of radii (n,)."""
    axes = (np.abs(error_mm) <= half_mm).mean(axis=0)
    radius = (np.linalg.norm(error_mm, axis=1) <= radius_mm).mean()
    return Coverage(tuple(axes.tolist()), float(radius))


def conformal_intervals(error_mm: Floats, formal_mm: Floats, independent: int) -> Intervals:
    """Find the number of formal standard deviations that contain 90 % of held-out errors.

    Args:
        error_mm: (n, 3) errors of rows held out of the model's fit, in the station's frame.
        formal_mm: (n, 3) formal standard deviations of these errors.
        independent: number of mutually independent rows, m. A new error exceeds the largest of m with probability
            1 / (m + 1), so fewer rows make the intervals wider.
    """
    scaled = np.abs(error_mm) / formal_mm
    norm = np.linalg.norm(error_mm, axis=1) / np.linalg.norm(formal_mm, axis=1)
    share = min(1.0, LEVEL * (1.0 + 1.0 / independent))
    x, y, z = np.quantile(scaled, share, axis=0).tolist()
    return Intervals((x, y, z), float(np.quantile(norm, share)))
