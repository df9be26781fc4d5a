"""Whether a link's loop was there to read what came: a stamp that is made at reading is worth no more than that."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Clock, Stamp

LATE_S = 0.25  # what is read later than this is given up, where nothing says when it came
NOT_READ_IN_TIME = "nobody read for a while: rigcal was stopped, or the computer too busy"


class Attendance:
    """Notices that a loop has come back after it was away: its program stopped or starved, or held up by a device.

    What has queued meanwhile, at a port whose kernel does not say when it came, would be stamped with the instant of
    reading: a fix would be joined with the joints of another pose. It must be discarded, as what waited at a port
    before it was opened is, and so must what an adapter still holds, which follows at once.

    Args:
        clock: of the stamps; how long the loop was away counts in real seconds, which is what computers take.

    Attributes:
        left: when the loop was last there before it was away; when it began if it never was.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._looked = self.left = clock.now()
        self._back: Stamp | None = None

    def is_late(self, now: Stamp, waited_s: float) -> bool:
        """Whether what was read just before `now` may have come long before. To be asked at every read.

        Args:
            now: after the read.
            waited_s: how long the read may have waited, real seconds.
        """
        if self._real_s(now, self._looked) > waited_s + LATE_S:
            self.left, self._back = self._looked, now
        self._looked = now
        return self._back is not None and self._real_s(now, self._back) <= LATE_S

    def _real_s(self, now: Stamp, since: Stamp) -> float:
        return self._clock.real_seconds(now.since(since) / NS_PER_S)
