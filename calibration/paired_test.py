"""Whether one estimate is better than another beyond chance: a paired one-sided t-test over groups of rows.

The one place where rigcal decides that something helps: for a learner within a calibration, and for a model that is to
take another's place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from calibration.observations import Floats

CHANCE = 0.01
WORTHWHILE = 0.01  # relative; a smaller gain is not worth a change


@dataclass(frozen=True)
class PairedTest:
    """Two estimates on the same rows.

    Attributes:
        before_mm, after_mm: RMS of the 3-D error over all rows.
        p: probability of such a gain by chance; 1 where fewer than two groups, or groups without any spread, allow
            no test.
        rows, groups: how many there were.
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
        """The second estimate is better beyond chance, and by enough to matter."""
        return self.p < CHANCE and self.after_mm < (1.0 - WORTHWHILE) * self.before_mm


def chance_of_mean(draws: Floats) -> float:
    """p of such a mean of independent draws (n,) where their true mean is zero or less: a one-sided t-test.

    1 where fewer than two draws, or draws without any spread, allow no test.
    """
    if len(draws) < 2 or (spread := float(draws.std(ddof=1))) == 0.0:
        return 1.0
    return float(stdtr(len(draws) - 1, -draws.mean() / (spread / np.sqrt(len(draws)))))


def paired_test(before_mm2: Floats, after_mm2: Floats, groups: NDArray[np.str_] | NDArray[np.intp]) -> PairedTest:
    """Compare squared errors, each group's mean gain taken as one draw.

    Args:
        before_mm2, after_mm2: (n,) squared 3-D errors of the two estimates, n > 0.
        groups: (n,) labels of rows whose errors hang together.
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
