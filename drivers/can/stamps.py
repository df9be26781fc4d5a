"""Stamps of received frames: the kernel's wall-clock time put on the link's own clock."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can.ports import Batch
from drivers.clock import Clock, Stamp

EXACT_NS = 1_000_000
"""UTC that is ahead of the monotonic clock by so much more or less has been set; less is the error of reading both."""

_NEVER_NS = 1 << 63


@dataclass(slots=True)
class _Epoch:
    """A time in which the wall clock was not set (monotonic instants, ns).

    Attributes:
        ahead_ns: UTC less the monotonic clock.
        since_ns, until_ns: it cannot have begun before, nor have ended after.
    """

    ahead_ns: int
    since_ns: int
    until_ns: int = _NEVER_NS

    def may_hold(self, utc_ns: int) -> bool:
        """Return True if the wall clock may have shown `utc_ns` in this epoch."""
        return self.since_ns - EXACT_NS <= utc_ns - self.ahead_ns <= self.until_ns + EXACT_NS


class ReceiveStamps:
    """Stamps what a link reads.

    The kernel's own receive time is better than that of reading by all that the scheduler adds, but it is on the wall
    clock. Between two settings of the wall clock (Linux slews both clocks alike) UTC is ahead of the monotonic clock by
    a constant. It is looked at before and after every read, so each setting is known to lie between two looks, and a
    frame's instant is the one that its kernel's time gives before or after the setting, whichever is possible: later
    than the start of the last read that left nothing, not later than now, and on its side of the setting. Where both
    are, or none is, the time of the frame is doubtful. How late it is read does not matter.

    Two kinds of frames have no time but that of reading, which is doubtful after a while in which nobody read: those
    of ports that the kernel does not stamp; and those that it stamps only when they are read, as it does on sockets
    within the host and until stamping is switched on. The latter never seem older than the read, so what seems to have
    come during a late read is believed only if an older frame has shown that this socket is stamped.

    Stamps never go back. A frame of doubtful time is stamped at the earliest instant that is possible, if the kernel
    has stamped it, so that it does not hold up those behind it; else when it was read.

    Args:
        clock: of the link.
        opened: the host's time just before the port was opened.

    Attributes:
        latest: the last stamp that was given; the opening before the first.
    """

    def __init__(self, clock: Clock, opened: Stamp) -> None:
        self._clock = clock
        self._epochs = [_Epoch(opened.utc_ns - opened.monotonic_ns, opened.monotonic_ns)]
        self._looked_ns = opened.monotonic_ns
        self._floor_ns = opened.monotonic_ns  # what is still to be read has arrived after this
        self._is_stamped = False
        self.latest = clock.of_host(opened)

    def of(self, batch: Batch, began: Stamp, ended: Stamp, *, is_late: bool) -> list[Stamp]:
        """Return the stamps of the frames of one read.

        Args:
            batch: the frames.
            began: the host's time just before the read.
            ended: the host's time just after the read.
            is_late: they may have waited long, as nobody read.
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
        """Notice that the wall clock was set."""
        ahead_ns = host.utc_ns - host.monotonic_ns
        epoch = self._epochs[-1]
        if abs(ahead_ns - epoch.ahead_ns) > EXACT_NS:
            epoch.until_ns = host.monotonic_ns
            self._epochs.append(_Epoch(ahead_ns, self._looked_ns))
        self._looked_ns = host.monotonic_ns

    def _stamp(self, kernel_utc_ns: int, began: Stamp, ended: Stamp, is_late: bool) -> Stamp:
        """The instant of a frame, on the host's clocks."""
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
