"""Clocks and stamps: every record carries three clocks, liveness uses the monotonic one alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

NS_PER_S = 1_000_000_000

_TIGHT_NS = 20_000  # three readings of clocks within this were not interrupted; they take a tenth of it
_READINGS = 8


@dataclass(frozen=True, slots=True)
class Stamp:
    """One instant on three clocks.

    Attributes:
        utc_ns: nanoseconds since 1970-01-01 UTC; may step when the host's clock is set.
        monotonic_ns: nanoseconds of the host's monotonic clock; never steps, restarts at boot.
        boot_id: which boot `monotonic_ns` belongs to.
        is_doubtful: what is stamped may have happened long before or after; nothing may rely on its time.
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
        """Return the nanoseconds since `earlier`: monotonic within one boot, UTC from one boot to another."""
        if self.boot_id == earlier.boot_id:
            return self.monotonic_ns - earlier.monotonic_ns
        return self.utc_ns - earlier.utc_ns


Order = Callable[[Stamp], tuple[int, int]]
"""Order of instants: the boot that an instant belongs to, and its place in it. UTC cannot tell, for a boot
may show an earlier time than the one before it."""


def lies_within(order: Order, stamp: Stamp, since: Stamp | None, until: Stamp | None) -> bool:
    """Return True if `stamp` lies between two instants, the first included; None is no bound."""
    at = order(stamp)
    return (since is None or at >= order(since)) and (until is None or at < order(until))


class Clock(Protocol):
    """A clock, passed to whatever needs time."""

    def now(self) -> Stamp:
        """Return this instant on all three clocks."""

    def monotonic_ns(self) -> int:
        """Return the monotonic clock alone, for deadlines."""

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of this clock pass."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait for `event` for at most `seconds` of this clock; True when it is set."""

    def real_seconds(self, seconds: float) -> float:
        """Convert seconds of this clock to real ones, as operating-system calls take them."""

    @property
    def host(self) -> Clock:
        """The host's own clocks, by which the kernel stamps what it receives."""

    def of_host(self, stamp: Stamp) -> Stamp:
        """Convert an instant of the host's clocks to this clock's."""


def read_boot_id() -> str:
    """Return the kernel's boot identifier (Linux, random(4)); "unknown" where there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"


class SystemClock:
    """The host's clocks.

    Args:
        utc_ns, monotonic_ns: read them.
    """

    def __init__(
        self, utc_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._utc_ns = utc_ns
        self._monotonic_ns = monotonic_ns
        self._boot_id = read_boot_id()

    def now(self) -> Stamp:
        """Return this instant on all three clocks.

        A thread can be interrupted between the readings of two clocks, for as long as the computer is busy. UTC is
        therefore read between two readings of the monotonic clock, and again if they lie apart; of several the tightest
        counts.
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
    """A clock that only moves when told to: tests, replay as fast as it goes, and simulators without a port.

    Args:
        start: its first instant.
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

    @property
    def host(self) -> Clock:
        return self._host

    def of_host(self, stamp: Stamp) -> Stamp:
        return self._now.doubted() if stamp.is_doubtful else self._now


class TimeBudget:
    """A time-out in real time that several steps share, whatever the rig's clock does; it runs from now on.

    Args:
        seconds: how long it lasts.
    """

    def __init__(self, seconds: float) -> None:
        self._clock = SystemClock()
        self._ends_ns = self._clock.monotonic_ns() + round(seconds * NS_PER_S)

    @property
    def left_s(self) -> float:
        """Seconds left, never negative: the time-out to give to a join or a wait."""
        return max(self._ends_ns - self._clock.monotonic_ns(), 0) / NS_PER_S

    @property
    def is_over(self) -> bool:
        """True when nothing is left."""
        return self.left_s == 0.0
