"""Time, passed in and never called: every record carries three clocks, liveness uses the monotonic one alone."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Stamp:
    """One instant on three clocks.

    Attributes:
        utc_ns: nanoseconds since 1970-01-01 UTC; may step when the host's clock is set.
        monotonic_ns: nanoseconds of the host's monotonic clock; never steps, restarts at boot.
        boot_id: which boot `monotonic_ns` belongs to.
    """

    utc_ns: int
    monotonic_ns: int
    boot_id: str

    def shifted(self, nanoseconds: int) -> Stamp:
        """The instant `nanoseconds` later (negative: earlier) on the same clocks."""
        return Stamp(self.utc_ns + nanoseconds, self.monotonic_ns + nanoseconds, self.boot_id)

    def since(self, earlier: Stamp) -> int:
        """Nanoseconds from `earlier` to this instant: monotonic within one boot, UTC from one boot to another."""
        if self.boot_id == earlier.boot_id:
            return self.monotonic_ns - earlier.monotonic_ns
        return self.utc_ns - earlier.utc_ns


class Clock(Protocol):
    """What the program may ask of time."""

    def now(self) -> Stamp:
        """This instant on all three clocks."""

    def monotonic_ns(self) -> int:
        """The monotonic clock alone, for deadlines."""

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of this clock pass."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait for `event` for at most `seconds` of this clock; True when it is set."""

    def real_seconds(self, seconds: float) -> float:
        """How long `seconds` of this clock last on the wall: the time-out to give to an operating-system call."""


def read_boot_id() -> str:
    """The kernel's boot identifier (Linux, random(4)); "unknown" where there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"


class SystemClock:
    """The host's clocks."""

    def __init__(self) -> None:
        self._boot_id = read_boot_id()

    def now(self) -> Stamp:
        return Stamp(time.time_ns(), time.monotonic_ns(), self._boot_id)

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return event.wait(seconds)

    def real_seconds(self, seconds: float) -> float:
        return seconds


class ScaledClock:
    """A clock that shows `origin` at one instant and runs `rate` times as fast as the host's from then on.

    Simulated processes share it by sharing rate and origin.

    Args:
        rate: seconds of this clock per real second, > 0.
        origin: what it shows when the host's monotonic clock shows `real_origin_ns`.
        real_origin_ns: when that is; when both clocks show the same by default.
    """

    def __init__(self, rate: float, origin: Stamp, real_origin_ns: int | None = None) -> None:
        if rate <= 0:
            raise ValueError(f"rate must be positive, got {rate}")
        self.rate = rate
        self.origin = origin
        self._real_origin_ns = origin.monotonic_ns if real_origin_ns is None else real_origin_ns

    def now(self) -> Stamp:
        return self.origin.shifted(self.monotonic_ns() - self.origin.monotonic_ns)

    def monotonic_ns(self) -> int:
        elapsed_ns = time.monotonic_ns() - self._real_origin_ns
        return self.origin.monotonic_ns + int(elapsed_ns * self.rate)

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds / self.rate)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return event.wait(seconds / self.rate)

    def real_seconds(self, seconds: float) -> float:
        return seconds / self.rate


class ManualClock:
    """A clock that only moves when told to: tests, replay as fast as it goes, and simulators without a port.

    Args:
        start: its first instant.
    """

    def __init__(self, start: Stamp = Stamp(1_700_000_000 * NS_PER_S, NS_PER_S, "manual")) -> None:
        self._now = start
        self._lock = threading.Lock()

    def now(self) -> Stamp:
        return self._now

    def monotonic_ns(self) -> int:
        return self._now.monotonic_ns

    def advance(self, seconds: float) -> None:
        """Move on by `seconds`."""
        with self._lock:
            self._now = self._now.shifted(round(seconds * NS_PER_S))

    def set(self, stamp: Stamp) -> None:
        """Jump to `stamp` (a captured record's instant)."""
        with self._lock:
            self._now = stamp

    def sleep(self, seconds: float) -> None:
        self.advance(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        if not event.is_set():
            self.advance(seconds)
        return event.is_set()

    def real_seconds(self, seconds: float) -> float:  # noqa: ARG002 - no real time passes
        return 0.0
