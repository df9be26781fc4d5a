"""Counts of the last half minute to minute."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from drivers.clock import NS_PER_S

WINDOW_NS = 30 * NS_PER_S


class RecentCounts:
    """Counts by name in the last one to two windows of `WINDOW_NS`. For one thread, or under its owner's lock."""

    def __init__(self) -> None:
        self._before, self._now = Counter[str](), Counter[str]()
        self._window_ns = 0

    def tell_time(self, now_ns: int) -> None:
        """Discard counts of windows that are over."""
        if now_ns - self._window_ns < WINDOW_NS:
            return
        is_next = now_ns - self._window_ns < 2 * WINDOW_NS
        self._before, self._now = self._now if is_next else Counter(), Counter()
        self._window_ns = now_ns

    def add(self, name: str, count: int = 1) -> None:
        """Count `count` occurrences of a name."""
        self._now[name] += count

    def update(self, names: Iterable[str]) -> None:
        """Count one occurrence of each name."""
        self._now.update(names)

    def __getitem__(self, name: str) -> int:
        return self._before[name] + self._now[name]
