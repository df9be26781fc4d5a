"""Whether the daemon's memory, descriptors and threads stay as they are once it is warm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from tests.soak.daemon_process import Usage

MOST_GROWTH = 0.05
MOST_MORE = 4  # descriptors and threads
WINDOW_S = 60.0  # what a store that cannot be written holds up for some seconds is no leak
FEWEST = 12


@dataclass(frozen=True)
class Growth:
    """How a process's usage changed after its warm-up.

    Attributes:
        warm_s, end_s: from when to when it was looked at, real seconds since its start.
        base_kib, end_kib, most_kib: anonymous memory at first, at last and at most: medians over a minute.
        trend: of a straight line through all samples from first to last, as a share of `base_kib`.
        descriptors, threads: at first and at last: the fewest within a minute, as clients come and go, while none
            hangs.
    """

    warm_s: float
    end_s: float
    base_kib: float
    end_kib: float
    most_kib: float
    trend: float
    descriptors: tuple[int, int]
    threads: tuple[int, int]

    def faults(self) -> list[str]:
        """What is not flat, in words."""
        found = []
        if self.most_kib > self.base_kib * (1 + MOST_GROWTH):
            share = 100 * (self.most_kib / self.base_kib - 1)
            found.append(
                f"memory grew from {self.base_kib / 1024:.1f} to {self.most_kib / 1024:.1f} MiB, {share:.1f} %"
            )
        if self.trend > MOST_GROWTH:
            found.append(f"memory rises by {100 * self.trend:.1f} % from warm-up to end")
        for name, (first, last) in (("descriptors", self.descriptors), ("threads", self.threads)):
            if last > first + MOST_MORE:
                found.append(f"{name} grew from {first} to {last}")
        return found


def growth(samples: Sequence[Usage], warm_s: float) -> Growth | None:
    """Of the process that lived longest, after `warm_s`; None if it was not seen for long enough.

    Memory is measured over windows of a minute, or a fifth of what there is to see of it.
    """
    lives: dict[int, list[Usage]] = {}
    for sample in samples:
        lives.setdefault(sample.life, []).append(sample)
    if not lives:
        return None
    longest = max(lives.values(), key=lambda life: life[-1].at_s)
    warm = [sample for sample in longest if sample.at_s >= warm_s]
    if len(warm) < FEWEST:
        return None
    begin_s, end_s = warm[0].at_s, warm[-1].at_s
    window_s = min(WINDOW_S, (end_s - begin_s) / 5)
    windows: dict[int, list[Usage]] = {}
    for sample in warm:
        windows.setdefault(
            min(int((sample.at_s - begin_s) / window_s), int((end_s - begin_s) / window_s) - 1), []
        ).append(sample)
    parts = [windows[number] for number in sorted(windows)]
    medians = [median(sample.anonymous_kib for sample in part) for part in parts]
    slope, _ = np.polyfit([s.at_s for s in warm], [s.anonymous_kib for s in warm], 1)
    return Growth(
        warm_s=begin_s,
        end_s=end_s,
        base_kib=medians[0],
        end_kib=medians[-1],
        most_kib=max(medians),
        trend=float(slope) * (end_s - begin_s) / medians[0],
        descriptors=(_fewest(parts[0], "descriptors"), _fewest(parts[-1], "descriptors")),
        threads=(_fewest(parts[0], "threads"), _fewest(parts[-1], "threads")),
    )


def _fewest(samples: Sequence[Usage], what: str) -> int:
    """Descriptors or threads of a minute, while no client hangs if there was such a moment."""
    quiet = [sample for sample in samples if not sample.hanging]
    return int(min(getattr(sample, what) for sample in quiet or samples))
