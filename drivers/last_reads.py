"""The last reads of a link that is to stop: what its port has received by then is still read."""

from __future__ import annotations

import threading

from drivers.clock import TimeBudget

LAST_READ_S = 0.02  # real seconds for each of the last reads
LAST_READS_S = 2.0  # real seconds for all of them, as a bus that is never silent would be read for ever
_FULL_TTY_BYTES = 3072


class LastReads:
    """Says when a link reads for the last times, and when it is done with that.

    Args:
        stop: is set when the link is to stop.
    """

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._budget: TimeBudget | None = None

    def have_begun(self) -> bool:
        """Return True once the link is to stop: it sends nothing more, and each read takes `LAST_READ_S` at most."""
        if self._budget is None and self._stop.is_set():
            self._budget = TimeBudget(LAST_READS_S)
        return self._budget is not None

    def are_over(self, *, is_emptied: bool) -> bool:
        """Return True if no more is to be read.

        Args:
            is_emptied: the read before, made after `have_begun`, has left nothing.
        """
        return self._budget is not None and (is_emptied or self._budget.is_over)


def more_may_wait(data: bytes) -> bool:
    """Return True if a read of a terminal returned so much that more may wait.

    Linux keeps 4 KiB ready, and moves up what waits behind it, 64 KiB and more, only after a read has made room.
    """
    return len(data) >= _FULL_TTY_BYTES
