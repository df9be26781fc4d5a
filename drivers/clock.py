"""Clocks and stamps. Every record has a stamp on three clocks; timeouts use only the monotonic clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

NS_PER_S = 1_000_000_000

SIMULATED_BOOT = "simulated-"  # beginning of the boot ids of simulated rigs

_TIGHT_NS = 20_000  # three clock readings within this time were not interrupted; they normally take a tenth of it
_READINGS = 8


@dataclass(frozen=True, slots=True)
class Stamp:
    """One instant on three clocks.

    Attributes:
        utc_ns: nanoseconds since 1970-01-01 UTC; may step when the host's clock is set.
        monotonic_ns: nanoseconds of the host's monotonic clock; never steps, restarts at boot.
        boot_id: identifier of the boot that `monotonic_ns` belongs to.
        is_doubtful: the real time may be much earlier or later, so nothing may rely on it.
    """

    utc_ns: int
    monotonic_ns: int
    boot_id: str
    is_doubtful: bool = False

    def shifted(self, nanoseconds: int) -> Stamp:
        """Return the instant `nanoseconds` later (negative: earlier) on the same clocks."""
        return Stamp(self.utc_ns + nanoseconds, self.monotonic_ns + nanoseconds, self.boot_id, self.is_doubtful)

    def doubted(self) -> Stamp:
        """Return the same instant, marked as doubtful."""
        return replace(self, is_doubtful=True)

    def since(self, earlier: Stamp) -> int:
        """Return the nanoseconds since `earlier`: on the monotonic clock within one boot, else on UTC."""
        if self.boot_id == earlier.boot_id:
            return self.monotonic_ns - earlier.monotonic_ns
        return self.utc_ns - earlier.utc_ns


Order = Callable[[Stamp], tuple[int, int]]
"""Sort key of instants: number of the boot, and position within it. UTC cannot be used, as a boot may show an earlier
time than the boot before it."""


def lies_within(order: Order, stamp: Stamp, since: Stamp | None, until: Stamp | None) -> bool:
    """Return True if `stamp` is at or after `since` and before `until`.

    Args:
        order: sort key of instants.
        stamp: instant to check.
        since: start, included; None for no start.
        until: end, excluded; None for no end.
    """
    at = order(stamp)
    return (since is None or at >= order(since)) and (until is None or at < order(until))


class Clock(Protocol):
    """A clock, passed to whatever needs time."""

    def now(self) -> Stamp:
        """Return the current time on all three clocks."""

    def monotonic_ns(self) -> int:
        """Return the monotonic clock only, for deadlines."""

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of this clock pass."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait for `event` for at most `seconds` of this clock; return True if it is set."""

    def real_seconds(self, seconds: float) -> float:
        """Convert seconds of this clock to real seconds, for operating-system calls."""

    @property
    def host(self) -> Clock:
        """The host's own clocks, with which the kernel timestamps received data."""

    def of_host(self, stamp: Stamp) -> Stamp:
        """Convert an instant of the host's clocks to this clock's."""


def read_boot_id() -> str:
    """Return the kernel's boot identifier (Linux, random(4)); "unknown" if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"


class SystemClock:
    """The host's clocks.

    Args:
        utc_ns, monotonic_ns: functions that read the two clocks.
    """

    def __init__(
        self, utc_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._utc_ns = utc_ns
        self._monotonic_ns = monotonic_ns
        self._boot_id = read_boot_id()

    def now(self) -> Stamp:
        """Return the current time on all three clocks.

        A thread can be interrupted between reading two clocks, for as long as the computer is busy. UTC is therefore
        read between two readings of the monotonic clock. If these lie too far apart, the readings are repeated, and the
        closest pair is used.
        """
        tightest_ns, ahead_ns = 1 << 63, 0
        after_ns = self._monotonic_ns()
        for _ in range(_READINGS):
            before_ns, utc_ns, after_ns = after_ns, self._utc_ns(), self._monotonic_ns()
            if after_ns - before_ns < tightest_ns:
                tightest_ns, ahead_ns = after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2
                if tightest_ns <= _TIGHT_NS:
                    break
        return Stamp(after_ns + ahead_ns, after_ns, self._boot_id)

    def monotonic_ns(self) -> int:
        return self._monotonic_ns()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return event.wait(seconds)

    def real_seconds(self, seconds: float) -> float:
        return seconds

    @property
    def host(self) -> Clock:
        return self

    def of_host(self, stamp: Stamp) -> Stamp:
        return stamp


class ScaledClock:
    """A clock that shows `origin` at one instant and runs `rate` times as fast as the host's clock.

    Simulated processes that use the same rate and origin have the same clock.

    Args:
        rate: seconds of this clock per real second, > 0.
        origin: time of this clock when the host's monotonic clock shows `real_origin_ns`.
        real_origin_ns: instant of the origin on the host's monotonic clock; None for `origin.monotonic_ns`.
    """

    def __init__(self, rate: float, origin: Stamp, real_origin_ns: int | None = None) -> None:
        if rate <= 0:
            raise ValueError(f"rate must be positive, got {rate}")
        self.rate = rate
        self.origin = origin
        self._real_origin_ns = origin.monotonic_ns if real_origin_ns is None else real_origin_ns
        self._host = SystemClock()

    def now(self) -> Stamp:
        return self.origin.shifted(self.monotonic_ns() - self.origin.monotonic_ns)

    def monotonic_ns(self) -> int:
        return self._at(time.monotonic_ns())

    def _at(self, real_ns: int) -> int:
        return self.origin.monotonic_ns + int((real_ns - self._real_origin_ns) * self.rate)

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds / self.rate)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return event.wait(seconds / self.rate)

    def real_seconds(self, seconds: float) -> float:
        return seconds / self.rate

    @property
    def host(self) -> Clock:
        return self._host

    def of_host(self, stamp: Stamp) -> Stamp:
        scaled = self.origin.shifted(self._at(stamp.monotonic_ns) - self.origin.monotonic_ns)
        return scaled.doubted() if stamp.is_doubtful else scaled


class ManualClock:
    """A clock that moves only on request: for tests, replay at full speed, and simulators without a port.

    Args:
        start: initial time.
    """

    def __init__(self, start: Stamp = Stamp(1_700_000_000 * NS_PER_S, NS_PER_S, "manual")) -> None:
        self._now = start
        self._host = SystemClock()
        self._lock = threading.Lock()

    def now(self) -> Stamp:
        return self._now

    def monotonic_ns(self) -> int:
        return self._now.monotonic_ns

    def advance(self, seconds: float) -> None:
        """Move forward by `seconds`."""
        with self._lock:
            self._now = self._now.shifted(round(seconds * NS_PER_S))

    def set(self, stamp: Stamp) -> None:
        """Set the clock to `stamp` (the instant of a captured record)."""
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

    @property
    def host(self) -> Clock:
        return self._host

    def of_host(self, stamp: Stamp) -> Stamp:
        return self._now.doubted() if stamp.is_doubtful else self._now


class TimeBudget:
    """A timeout in real time that several steps share, independent of the rig's clock; it starts on creation.

    Args:
        seconds: duration.
    """

    def __init__(self, seconds: float) -> None:
        self._clock = SystemClock()
        self._ends_ns = self._clock.monotonic_ns() + round(seconds * NS_PER_S)

    @property
    def left_s(self) -> float:
        """Seconds left, never negative; use this as the timeout of a join or wait."""
        return max(self._ends_ns - self._clock.monotonic_ns(), 0) / NS_PER_S

    @property
    def is_over(self) -> bool:
        """True when no time is left."""
        return self.left_s == 0.0
