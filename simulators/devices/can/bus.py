"""The simulated CAN bus: frames, the devices that send them, and the machine's own CANopen master."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

_START_DELAY_S = 0.05  # from a node's boot-up to its start command


class Frame(NamedTuple):
    """A CAN frame.

    Attributes:
        arbitration_id: 11 or 29 bit; SocketCAN's error class bits if `is_error`.
        data: 0 to 8 bytes.
        is_extended, is_remote, is_error: flags.
    """

    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False


class BusDevice(Protocol):
    """A device that sends frames without being asked. Times are simulated seconds."""

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that are due."""

    def next_deadline(self) -> float:
        """Return the instant at which the next frames are due."""


class BusController:
    """Starts every node that reports a boot-up, also after a reboot, and sends SYNC.

    Args:
        sync_period_s: SYNC interval; None for no SYNC.
    """

    def __init__(self, sync_period_s: float | None) -> None:
        self._sync_period_s = sync_period_s
        self._next_sync_s = 0.0 if sync_period_s else math.inf
        self._starts: list[tuple[float, int]] = []

    def receive(self, frame: Frame, now_s: float) -> None:
        """Process a frame on the bus."""
        if frame.arbitration_id & ~0x7F == 0x700 and frame.data == b"\x00":
            self._starts.append((now_s + _START_DELAY_S, frame.arbitration_id & 0x7F))

    def poll(self, now_s: float) -> list[Frame]:
        """Return the frames that are due."""
        frames = [Frame(0x000, bytes([0x01, node])) for at_s, node in self._starts if at_s <= now_s]
        self._starts = [start for start in self._starts if start[0] > now_s]
        if now_s >= self._next_sync_s and self._sync_period_s:
            late = now_s - self._next_sync_s >= self._sync_period_s
            self._next_sync_s = (now_s if late else self._next_sync_s) + self._sync_period_s
            frames.append(Frame(0x080, b""))
        return frames

    def next_deadline(self) -> float:
        """Return the instant at which `poll` is due."""
        return min([self._next_sync_s, *(at_s for at_s, _ in self._starts)])
