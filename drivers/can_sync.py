"""When SYNC is due."""

from __future__ import annotations

from drivers.canframe import Frame
from drivers.cia301 import SYNC_COUNTER_MAX, encode_sync


class SyncProducer:
    """When to send SYNC: on a fixed monotonic grid, without drift and without bursts after a stall.

    Args:
        period_ns: of the grid.
        start_ns: its first instant, monotonic.
        with_counter: the SYNC carries a counter 1 to 240.
    """

    def __init__(self, period_ns: int, start_ns: int, with_counter: bool) -> None:
        self._period_ns = period_ns
        self._counter = 0 if with_counter else None
        self.next_ns = start_ns

    def due(self, monotonic_ns: int) -> Frame | None:
        """The SYNC to send now; None before `next_ns`."""
        if monotonic_ns < self.next_ns:
            return None
        self.next_ns += self._period_ns * ((monotonic_ns - self.next_ns) // self._period_ns + 1)
        if self._counter is not None:
            self._counter = self._counter % SYNC_COUNTER_MAX + 1
        return encode_sync(self._counter)
