"""When a received frame arrived: the kernel's wall-clock time put on the link's own clock."""

from __future__ import annotations

from drivers.clock import Stamp

_LATE_NS = 10_000_000  # between the last read and the reading of the clock behind it


class ReceiveStamps:
    """Puts received frames on the link's clock.

    The kernel's own receive time is better than ours by all that the scheduler adds, but it is on the wall clock, which
    may have been stepped in between, and means nothing on a scaled clock. It is used as an age, and only if that age
    lies between now and the read that last emptied the buffer; else the frame arrived now. Stamps never go back.

    Args:
        opened: when the bus was opened.

    Attributes:
        latest: the last stamp that was given.
    """

    def __init__(self, opened: Stamp) -> None:
        self.latest = opened
        self._emptied_ns = opened.monotonic_ns

    def stamp(self, kernel_utc_ns: int | None, now: Stamp) -> Stamp:
        """The instant of a frame that was read just before `now`."""
        stamp = now
        if kernel_utc_ns is not None:
            age_ns = now.utc_ns - kernel_utc_ns
            if 0 <= age_ns <= now.monotonic_ns - self._emptied_ns + _LATE_NS:
                stamp = Stamp(kernel_utc_ns, now.monotonic_ns - age_ns, now.boot_id)
            if stamp.monotonic_ns < self.latest.monotonic_ns:
                stamp = self.latest
        self.latest = stamp
        return stamp

    def emptied(self, now: Stamp) -> None:
        """Nothing was left to read: what comes next has arrived after this."""
        self._emptied_ns = now.monotonic_ns
