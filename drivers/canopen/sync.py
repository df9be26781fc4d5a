"""SYNC (CiA 301): when to send it, and which PDOs were sampled at it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can.frame import Frame
from drivers.clock import NS_PER_S, Stamp

SYNC_ID = 0x080
SYNC_WINDOW_NS = NS_PER_S // 10
"""Longest time from a SYNC to a PDO sampled at it; ten nodes at 20 kbit/s need 60 ms."""


@dataclass(frozen=True, slots=True)
class Sync:
    """A SYNC on the bus.

    Attributes:
        stamp: when it was sent or received.
        number: number of SYNCs before it.
    """

    stamp: Stamp
    number: int = 0


class SyncProducer:
    """Sends SYNC on a fixed monotonic grid, without drift and without bursts after a stall.

    Args:
        period_ns: period of the grid.
        start_ns: first instant of the grid, monotonic.

    Attributes:
        next_ns: the next instant at which SYNC is due.
    """

    def __init__(self, period_ns: int, start_ns: int) -> None:
        self._period_ns = period_ns
        self.next_ns = start_ns

    def due(self, monotonic_ns: int) -> Frame | None:
        """Return the SYNC to send now; None before `next_ns`."""
        if monotonic_ns < self.next_ns:
            return None
        self.next_ns += self._period_ns * ((monotonic_ns - self.next_ns) // self._period_ns + 1)
        return Frame(SYNC_ID, b"")


class SyncSampling:
    """Finds when a synchronous channel was sampled: the first PDO after a SYNC was sampled at that SYNC."""

    def __init__(self) -> None:
        self._used: Sync | None = None

    def instant(self, stamp: Stamp, sync: Sync | None) -> Stamp:
        """Return when the values of a PDO were sampled.

        Args:
            stamp: when the PDO was received.
            sync: the last SYNC; None if there was none.
        """
        if sync is None or sync is self._used:
            return stamp
        self._used = sync
        sampled = sync.stamp
        is_sampled = 0 <= stamp.since(sampled) <= SYNC_WINDOW_NS and not (stamp.is_doubtful or sampled.is_doubtful)
        return sampled if is_sampled else stamp
