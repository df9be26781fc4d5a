"""Stamps of received frames: the kernel's wall-clock time converted to the link's own clock."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can.port import Batch
from drivers.clock import Clock, Stamp

EXACT_NS = 1_000_000
"""A larger change of UTC minus monotonic clock means that the wall clock was set; less is the error of reading both."""

_NEVER_NS = 1 << 63


@dataclass(slots=True)
class _Epoch:
    """A period during which the wall clock was not set (monotonic instants, ns).

    Attributes:
        ahead_ns: UTC minus the monotonic clock.
        since_ns, until_ns: earliest possible start and latest possible end.
    """

    ahead_ns: int
    since_ns: int
    until_ns: int = _NEVER_NS

    def may_hold(self, utc_ns: int) -> bool:
        """Return True if the wall clock may have shown `utc_ns` in this epoch."""
        return self.since_ns - EXACT_NS <= utc_ns - self.ahead_ns <= self.until_ns + EXACT_NS


class ReceiveStamps:
    """Timestamps the frames that a link reads.

    The kernel's receive time is better than the time of reading, as it contains no scheduling delay, but it is on the
    wall clock. Between two settings of the wall clock, UTC is ahead of the monotonic clock by a constant (Linux slews
    both clocks alike). This offset is checked before and after every read, so each setting is known to lie between two
    checks. With the offset before the setting and the offset after it, the kernel's time of a frame gives two candidate
    instants. A candidate is possible if it is later than the start of the last read that left nothing unread, not later
    than now, and on its own side of the setting. If exactly one candidate is possible, it is the frame's instant;
    otherwise the time of the frame is doubtful. How late the frame is read does not matter.

    Two kinds of frames only have the time of reading, which is doubtful if the port was not read for a while: frames of
    ports without kernel timestamps, and frames that the kernel timestamps only when they are read (on sockets within
    the host, and until timestamping is switched on). Frames of the second kind never appear older than the read. A
    frame that appears to have arrived during a late read is therefore trusted only if an older frame has shown that
    this socket is timestamped on arrival.

    Stamps never go back. A frame of doubtful time gets the earliest possible instant if the kernel has timestamped it,
    so that it does not delay the stamps of the frames behind it; otherwise it gets the time of reading.

    Args:
        clock: clock of the link.
        opened: the host's time just before the port was opened.

    Attributes:
        latest: the last stamp returned; before the first, the time of opening.
    """

    def __init__(self, clock: Clock, opened: Stamp) -> None:
        self._clock = clock
        self._epochs = [_Epoch(opened.utc_ns - opened.monotonic_ns, opened.monotonic_ns)]
        self._looked_ns = opened.monotonic_ns
        self._floor_ns = opened.monotonic_ns  # all unread frames arrived after this instant
        self._is_stamped = False
        self.latest = clock.of_host(opened)

    def of(self, batch: Batch, began: Stamp, ended: Stamp, *, is_late: bool) -> list[Stamp]:
        """Return the stamps of the frames of one read.

        Args:
            batch: the frames.
            began: the host's time just before the read.
            ended: the host's time just after the read.
            is_late: the frames may have waited long, because the port was not read.
        """
        self._look(began)
        self._look(ended)
        stamps = []
        for _, kernel_utc_ns in batch.received:
            if kernel_utc_ns is None:
                stamp = ended.doubted() if is_late else ended
            else:
                stamp = self._stamp(kernel_utc_ns, began, ended, is_late)
            stamps.append(self._clock.of_host(stamp))
        if stamps:
            self.latest = stamps[-1]
        if batch.is_last:
            self._floor_ns = max(self._floor_ns, began.monotonic_ns)
            self._epochs = [epoch for epoch in self._epochs if epoch.until_ns >= self._floor_ns]
        return stamps

    def _look(self, host: Stamp) -> None:
        """Check whether the wall clock was set since the last check, and begin a new epoch if so."""
        ahead_ns = host.utc_ns - host.monotonic_ns
        epoch = self._epochs[-1]
        if abs(ahead_ns - epoch.ahead_ns) > EXACT_NS:
            epoch.until_ns = host.monotonic_ns
            self._epochs.append(_Epoch(ahead_ns, self._looked_ns))
        self._looked_ns = host.monotonic_ns

    def _stamp(self, kernel_utc_ns: int, began: Stamp, ended: Stamp, is_late: bool) -> Stamp:
        """Return the stamp of a frame on the host's clocks."""
        floor_ns, ended_ns = self._floor_ns, ended.monotonic_ns
        earliest_ns, latest_ns = floor_ns - EXACT_NS, ended_ns + EXACT_NS
        possible = [
            epoch
            for epoch in self._epochs
            if earliest_ns <= kernel_utc_ns - epoch.ahead_ns <= latest_ns and epoch.may_hold(kernel_utc_ns)
        ]
        if len(possible) == 1:
            ahead_ns = possible[0].ahead_ns
            at_ns = kernel_utc_ns - ahead_ns
            if at_ns < began.monotonic_ns - EXACT_NS:
                self._is_stamped = True
            if self._is_stamped or not is_late:
                if at_ns < floor_ns:
                    at_ns = floor_ns
                elif at_ns > ended_ns:
                    at_ns = ended_ns
                self._floor_ns = at_ns
                return Stamp(at_ns + ahead_ns, at_ns, ended.boot_id)
        return Stamp(floor_ns + self._epochs[-1].ahead_ns, floor_ns, ended.boot_id, True)
