"""A paired t-test, the tail of a sample, a cumulative sum chart, and evenly spread points.

scipy.stats has similar functions, but importing it takes half a second in every command.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Alarm = Literal["none", "worse", "better"]

CHANCE = 0.01  # p-value below which a gain is significant
WORTHWHILE = 0.01  # least relative gain that justifies a change

# A standstill has three coordinates. Further fixes of it share the errors of its readings, so they scatter less.
_FREEDOM = 3.0
_MIDDLE = 1.0 - 2.0 / (9.0 * _FREEDOM)
_SPREAD = math.sqrt(2.0 / (9.0 * _FREEDOM))
_SYMMETRIC = 1e-5  # skewness
REFERENCE = 1.0  # tolerated shift of the mean score: errors of 1.3 times the predicted RMS
DECISION = 5.0  # about one false alarm in 100,000 independent N(0, 1) scores (Siegmund 1985)
CLIP = 3.0  # winsorised chart, so that a single wrong fix never raises an alarm


@dataclass(frozen=True)
class PairedTest:
    """Two estimates compared on the same rows.

    Attributes:
        before_mm: RMS of the first estimate's 3-D error over all rows.
        after_mm: the same of the second estimate.
        p: probability of such a gain by chance; 1 if there are fewer than two groups or their gains have no spread.
        rows: number of rows.
        groups: number of groups.
        no_worse: share of the groups in which the second estimate is no worse.
    """

    before_mm: float
    after_mm: float
    p: float
    rows: int
    groups: int
    no_worse: float

    @property
    def is_better(self) -> bool:
        """True if the second estimate is better by a significant and relevant amount."""
        return self.p < CHANCE and self.after_mm < (1.0 - WORTHWHILE) * self.before_mm


def chance_of_mean(draws: Floats) -> float:
    """Return the p-value of a one-sided one-sample t-test of mean > 0.

    Args:
        draws: (n,) independent draws; p is 1 if there are fewer than two or they have no spread.
    """
    if len(draws) < 2 or (spread := float(draws.std(ddof=1))) == 0.0:
        return 1.0
    from scipy.special import stdtr  # imported here, so that the daemon, which makes no tests, runs without scipy

    return float(stdtr(len(draws) - 1, -draws.mean() / (spread / np.sqrt(len(draws)))))


def chance_beyond(value: float, draws: Floats) -> float:
    """Return the probability of exceeding a value, by the gamma distribution with the first three moments of draws.

    This is Pearson's type III distribution, which sums of squares follow closely.

    Args:
        value: any value.
        draws: (n,) draws of the same quantity; without any spread the probability is 1.
    """
    from scipy.special import gammainc, gammaincc, ndtr

    mean, spread = float(draws.mean()), float(draws.std())
    if spread == 0.0:
        return 1.0
    at, skewness = (value - mean) / spread, float(((draws - mean) ** 3).mean()) / spread**3
    if abs(skewness) < _SYMMETRIC:
        return float(ndtr(-at))
    shape = 4.0 / skewness**2
    gamma = max(shape + at * math.sqrt(shape) * math.copysign(1.0, skewness), 0.0)
    return float((gammaincc if skewness > 0.0 else gammainc)(shape, gamma))


def paired_test(before_mm2: Floats, after_mm2: Floats, groups: NDArray[np.str_] | NDArray[np.intp]) -> PairedTest:
    """Compare the squared errors of two estimates by a paired one-sided t-test over groups of rows.

    This test decides whether a residual learner is kept in a calibration, and whether a model replaces the current one.

    Args:
        before_mm2: (n,) squared 3-D errors of the first estimate, n > 0.
        after_mm2: (n,) the same of the second.
        groups: (n,) labels; rows with dependent errors have the same one. The mean gain of each group is one draw.
    """
    _, index, size = np.unique(groups, return_inverse=True, return_counts=True)
    gain = np.bincount(index, before_mm2 - after_mm2) / size
    return PairedTest(
        before_mm=float(np.sqrt(before_mm2.mean())),
        after_mm=float(np.sqrt(after_mm2.mean())),
        p=chance_of_mean(gain),
        rows=len(before_mm2),
        groups=len(gain),
        no_worse=float((gain >= 0.0).mean()),
    )


def score(mean_square: float) -> float:
    """Return the score of a standstill, which is about N(0, 1) if the model is correct.

    The cube root of a mean of squares is close to normal (Wilson and Hilferty, PNAS 17, 1931).

    Args:
        mean_square: mean square of the standardised errors of its three coordinates.
    """
    normal = (math.cbrt(mean_square) - _MIDDLE) / _SPREAD
    return min(max(normal, -CLIP), CLIP)


@dataclass(frozen=True)
class Cusum:
    """A two-sided cumulative sum chart of scores (Page, Biometrika 41, 1954).

    Attributes:
        upper: rises with errors larger than the model predicts.
        lower: rises with errors smaller than it predicts.
    """

    upper: float = 0.0
    lower: float = 0.0

    def after(self, scores: Iterable[float]) -> Cusum:
        """Return the chart after further scores, in their order."""
        upper, lower = self.upper, self.lower
        for value in scores:
            upper = max(0.0, upper + value - REFERENCE)
            lower = max(0.0, lower - value - REFERENCE)
        return Cusum(upper, lower)

    @property
    def alarm(self) -> Alarm:
        """`worse`: the model no longer describes the machine; `better`: the model's sigma is too large."""
        if self.upper > DECISION:
            return "worse"
        return "better" if self.lower > DECISION else "none"


def halton(dimensions: int, count: int) -> Floats:
    """Return points that fill the unit box evenly (Halton 1960).

    Args:
        dimensions: number of columns; each has its own prime base.
        count: number of rows; row k is the number k with its digits mirrored at the radix point.

    Returns:
        (count, dimensions) points in [0, 1).
    """
    points = np.zeros((count, dimensions))
    primes = (n for n in itertools.count(2) if all(n % divisor for divisor in range(2, n)))
    for axis, base in zip(range(dimensions), primes, strict=False):
        left, unit = np.arange(count), 1.0 / base
        while left.any():
            left, digit = np.divmod(left, base)
            points[:, axis] += unit * digit
            unit /= base
    return points
