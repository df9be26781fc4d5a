"""The last reads of a link that is stopping: data that its port has already received is still read."""

from __future__ import annotations

import threading

from drivers.clock import TimeBudget

LAST_READ_S = 0.02  # real seconds for each of the last reads
LAST_READS_S = 2.0  # real seconds for all of them together, as a bus that is never silent could be read forever
_FULL_TTY_BYTES = 3072


class LastReads:
    """Decides when a link begins its last reads, and when it ends them.

    Args:
        stop: event that is set when the link is to stop.
    """

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._budget: TimeBudget | None = None

    def have_begun(self) -> bool:
        """Return True once the link is to stop: it sends nothing more, and each read waits at most `LAST_READ_S`."""
        if self._budget is None and self._stop.is_set():
            self._budget = TimeBudget(LAST_READS_S)
        return self._budget is not None

    def are_over(self, *, is_emptied: bool) -> bool:
        """Return True if nothing more is to be read.

        Args:
            is_emptied: the previous read, made after `have_begun`, left nothing unread.
        """
        return self._budget is not None and (is_emptied or self._budget.is_over)


def more_may_wait(data: bytes) -> bool:
    """Return True if a read from a terminal returned so much that more data may be waiting.

    Linux keeps 4 KiB ready to read. It moves up the data waiting behind (64 KiB and more) only after a read made room.
    """
    return len(data) >= _FULL_TTY_BYTES
