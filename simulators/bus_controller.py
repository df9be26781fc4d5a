"""The machine's own CANopen master: starts nodes that have booted, and keeps the beat with SYNC."""

from __future__ import annotations

import math

from simulators.frame import Frame

_START_DELAY_S = 0.05  # from a node's boot-up to its start command


class BusController:
    """Starts every node that reports its boot-up, again after a reboot; sends SYNC.

    Args:
        sync_period_s: SYNC interval; None sends none.
    """

    def __init__(self, sync_period_s: float | None) -> None:
        self._sync_period_s = sync_period_s
        self._next_sync_s = 0.0 if sync_period_s else math.inf
        self._starts: list[tuple[float, int]] = []

    def receive(self, frame: Frame, now_s: float) -> None:
        """A frame on the bus."""
        if frame.arbitration_id & ~0x7F == 0x700 and frame.data == b"\x00":
            self._starts.append((now_s + _START_DELAY_S, frame.arbitration_id & 0x7F))

    def poll(self, now_s: float) -> list[Frame]:
        """The frames that are due."""
        frames = [Frame(0x000, bytes([0x01, node])) for at_s, node in self._starts if at_s <= now_s]
        self._starts = [start for start in self._starts if start[0] > now_s]
        if now_s >= self._next_sync_s and self._sync_period_s:
            late = now_s - self._next_sync_s >= self._sync_period_s
            self._next_sync_s = (now_s if late else self._next_sync_s) + self._sync_period_s
            frames.append(Frame(0x080, b""))
        return frames

    def next_deadline(self) -> float:
        """When `poll` will have something to do."""
        return min([self._next_sync_s, *(at_s for at_s, _ in self._starts)])
