"""The last reads of a link that is stopping or cannot send: data that its port has received is still read."""

from __future__ import annotations

import threading

from drivers.clock import TimeBudget
from drivers.errors import LinkError

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
        self._failure: LinkError | None = None

    def begin(self, failure: LinkError) -> None:
        """Begin the last reads of a link that failed to send; `are_over` raises the failure once they are over."""
        self._failure = failure
        self._budget = TimeBudget(LAST_READS_S)

    def have_begun(self) -> bool:
        """Return True once they have begun: the link sends nothing more, and a read waits at most `LAST_READ_S`."""
        if self._budget is None and self._stop.is_set():
            self._budget = TimeBudget(LAST_READS_S)
        return self._budget is not None

    def are_over(self, *, is_emptied: bool) -> bool:
        """Return True if nothing more is to be read.

        Args:
            is_emptied: the previous read, made after `have_begun`, left nothing unread.

        Raises:
            LinkError: nothing more is to be read, and this is why the link failed to send.
        """
        is_over = self._budget is not None and (is_emptied or self._budget.is_over)
        if is_over and self._failure is not None:
            raise self._failure
        return is_over


def more_may_wait(data: bytes) -> bool:
    """Return True if a read from a terminal returned so much that more data may be waiting.

    Linux keeps 4 KiB ready to read. It moves up the data waiting behind (64 KiB and more) only after a read made room.
    """
    return len(data) >= _FULL_TTY_BYTES
