"""Detection of stalls of a link's loop: what was not read in time has no time of its own."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import DeviceEvent, EventKind, Gap, GapReason

LATE_S = 0.25  # what is read later than this is marked as of doubtful time, where nothing says when it came
NOT_READ_IN_TIME = "nobody read for a while: rigcal was stopped, or the computer too busy"
CLOCK_WAS_SET = "the computer's clock was set at that time"
_REPORT_NS = NS_PER_S


class StallDetector:
    """Detects that a loop stood still: its program was stopped or starved, or held up by a device.

    What has queued meanwhile, at a port whose kernel does not say when it came, is stamped with the instant of reading:
    a fix would be joined with the joints of another pose. Its stamp must be marked as doubtful, and so must that of
    what an adapter still holds, which follows at once.

    So it is with what a port received while it was opened: adapters that start anew when they are opened are given two
    seconds for it, and one that a killed program has left open sends on meanwhile.

    Args:
        clock: of the stamps; how long the loop stood still counts in real seconds, which is what computers take.
        opened: just before the port was opened; now by default.
    """

    def __init__(self, clock: Clock, opened: Stamp | None = None) -> None:
        self._clock = clock
        self._last_read = opened or clock.now()
        self._resumed: Stamp | None = None

    def is_late(self, now: Stamp, waited_s: float) -> bool:
        """Return True if the data read just before `now` may have arrived long before. Call it at every read.

        Args:
            now: after the read.
            waited_s: how long the read may have waited, real seconds.
        """
        if self._real_s(now, self._last_read) > waited_s + LATE_S:
            self._resumed = now
        self._last_read = now
        return self._resumed is not None and self._real_s(now, self._resumed) <= LATE_S

    def found_nothing(self, now: Stamp) -> None:
        """Note that nothing waited in a port that has just been opened: what comes from `now` on is new."""
        self._last_read = now

    def _real_s(self, now: Stamp, since: Stamp) -> float:
        return self._clock.real_seconds(now.since(since) / NS_PER_S)


class LateReport:
    """Reports captures that were stored with a doubtful time: an event and a gap, at most once a second.

    Args:
        link: name of the link.
        what: is counted, `frames` or `bytes`.
        start: when the link began to read.
    """

    def __init__(self, link: str, what: str, start: Stamp) -> None:
        self._link = link
        self._what = what
        self._in_time = start  # the last instant before which nothing was doubtful
        self._count = 0
        self._reason = ""

    def add(self, count: int, reason: str) -> None:
        """Add `count` captures, or bytes of them, that were marked as doubtful for `reason`."""
        self._count += count
        self._reason = reason

    def in_time(self, now: Stamp) -> list[DeviceEvent | Gap]:
        """Note that what was read at `now` was read in time; return the report if one is due."""
        if self._count and now.since(self._in_time) < _REPORT_NS:
            return []
        return self.end(now)

    def end(self, now: Stamp) -> list[DeviceEvent | Gap]:
        """Return the report of all that was added since the last one; empty if nothing was."""
        start, self._in_time = self._in_time, now
        count, self._count = self._count, 0
        if not count:
            return []
        text = f"{self._link}: {count} {self._what} are stored, but marked, as their time is doubtful: {self._reason}"
        return [
            DeviceEvent(self._link, now, EventKind.TIME_DOUBTFUL, text, count),
            Gap(self._link, GapReason.TIME_DOUBTFUL, start, now),
        ]
