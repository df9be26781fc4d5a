"""Summary of a CAN link by identifier: counts, rates, ages and known losses of frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.clock import NS_PER_S, Stamp

RATE_WINDOW_NS = 10 * NS_PER_S
_MARK_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class IdSummary:
    """Counts of one identifier.

    Attributes:
        arbitration_id, is_extended: the identifier.
        names: the channels that use it; for other identifiers the meaning that it shows itself, or "".
        count: number of frames since the start.
        rate_per_s: rate over about the last 10 s; None until it is known.
        age_s: time since the last frame; None if there was none.
        missed: number of frames lost since the start according to the frames' message counter; None if they have no
            working counter.
    """

    arbitration_id: int
    is_extended: bool
    names: str
    count: int
    rate_per_s: float | None
    age_s: float | None
    missed: int | None


@dataclass(frozen=True, slots=True)
class CanSummary:
    """Counts of one link.

    Attributes:
        link: name of the link.
        ids: sorted by identifier; includes the identifiers of channels that were never received.
        unlisted_frames: number of frames with identifiers beyond those that are counted one by one.
        error_frames: number of error frames since the start.
    """

    link: str
    ids: tuple[IdSummary, ...]
    unlisted_frames: int
    error_frames: int


class RateWindow:
    """Snapshots of counts, a second or more apart, over the last RATE_WINDOW_NS."""

    def __init__(self) -> None:
        self._marks: deque[tuple[Stamp, Mapping[int, int]]] = deque()

    def is_due(self, now: Stamp) -> bool:
        """Return True if `mark` is due."""
        return not self._marks or not 0 <= now.since(self._marks[-1][0]) < _MARK_NS

    def mark(self, now: Stamp, counts: Mapping[int, int]) -> None:
        """Store a snapshot of the current counts (key -> count) and discard those that are too old."""
        marks = self._marks
        if marks and now.since(marks[-1][0]) < 0:
            marks.clear()
        marks.append((now, counts))
        while len(marks) > 2 and now.since(marks[1][0]) >= RATE_WINDOW_NS:
            marks.popleft()

    def rates_per_s(self) -> dict[int, float]:
        """Return the rate by key at the last snapshot; empty before the second."""
        if len(self._marks) < 2:
            return {}
        (first, before), (last, after) = self._marks[0], self._marks[-1]
        elapsed_s = last.since(first) / NS_PER_S
        return {key: (count - before.get(key, 0)) / elapsed_s for key, count in after.items()}
