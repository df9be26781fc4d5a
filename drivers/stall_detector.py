"""Detection of stalls of a link's loop: data that was not read in time has no reliable time."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import DeviceEvent, EventKind, Gap, GapReason

LATE_S = 0.25  # data without a receive time that is read later than this is marked as doubtful
NOT_READ_IN_TIME = "the port was not read for a while, because rigcal was stopped or the computer was too busy"
CLOCK_WAS_SET = "the computer's clock was set at that time"
_REPORT_NS = NS_PER_S


class StallDetector:
    """Detects that a loop stalled: its program was stopped, got no CPU time, or was blocked by a device.

    Data that queued in the meantime, at a port whose kernel does not record when it arrived, is stamped with the time
    of reading: a fix would be combined with the joints of a different pose. Its stamp must be marked as doubtful, and
    so must the stamp of data that an adapter still holds, which follows at once.

    The same applies to data that a port received while it was being opened: adapters that restart when they are opened
    get two seconds for it, and an adapter that a killed program left open keeps sending in the meantime.

    Args:
        clock: clock of the stamps; the length of a stall is measured in real seconds.
        opened: time just before the port was opened; the current time by default.
    """

    def __init__(self, clock: Clock, opened: Stamp | None = None) -> None:
        self._clock = clock
        self._last_read = opened or clock.now()
        self._resumed: Stamp | None = None

    def is_late(self, now: Stamp, waited_s: float) -> bool:
        """Return True if the data read just before `now` may have arrived long before. Call this at every read.

        Args:
            now: time after the read.
            waited_s: longest time that the read may have waited, in real seconds.
        """
        if self._real_s(now, self._last_read) > waited_s + LATE_S:
            self._resumed = now
        self._last_read = now
        return self._resumed is not None and self._real_s(now, self._resumed) <= LATE_S

    def found_nothing(self, now: Stamp) -> None:
        """Note that a port that was just opened held no data, so all data from `now` on is new."""
        self._last_read = now

    def _real_s(self, now: Stamp, since: Stamp) -> float:
        return self._clock.real_seconds(now.since(since) / NS_PER_S)


class LateReport:
    """Reports captures that were stored with a doubtful time: an event and a gap, at most once a second.

    Args:
        link: name of the link.
        what: unit of the count, `frames` or `bytes`.
        start: when the link began to read.
    """

    def __init__(self, link: str, what: str, start: Stamp) -> None:
        self._link = link
        self._what = what
        self._in_time = start  # the last instant at which nothing was doubtful
        self._first = start  # when the first of those that are not reported yet was read
        self._count = 0
        self._reason = ""

    def add(self, now: Stamp, count: int, reason: str) -> list[DeviceEvent | Gap]:
        """Add `count` frames or bytes, read at `now`, that were marked as doubtful because of `reason`.

        Returns:
            The report if one is due: a link that is never read in time reports too.
        """
        if not self._count:
            self._first = now
        self._count += count
        self._reason = reason
        return self.end(now) if now.since(self._first) >= _REPORT_NS else []

    def in_time(self, now: Stamp) -> list[DeviceEvent | Gap]:
        """Note that the data read at `now` was read in time; return the report if one is due."""
        if self._count and now.since(self._in_time) < _REPORT_NS:
            return []
        return self.end(now)

    def end(self, now: Stamp) -> list[DeviceEvent | Gap]:
        """Return the report of everything added since the last report; empty if nothing was added."""
        start, self._in_time = self._in_time, now
        count, self._count = self._count, 0
        if not count:
            return []
        text = (
            f"{self._link}: {count} {self._what} are stored but not used for calibration, as their time is doubtful: "
            f"{self._reason}"
        )
        return [
            DeviceEvent(self._link, now, EventKind.TIME_DOUBTFUL, text, count),
            Gap(self._link, GapReason.TIME_DOUBTFUL, start, now),
        ]
