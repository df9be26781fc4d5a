"""Finds a second device with the number of a node, by the PDOs of both: a node sends its PDO once after a SYNC."""

from __future__ import annotations

from collections import deque

from drivers.canopen.sync import SYNC_WINDOW_NS, Sync
from drivers.clock import Stamp

_FOUND_AFTER = 5
_GONE_AFTER = 10  # SYNCs with a single PDO
_AGREE_AFTER = 100  # SYNCs without different data: each frame arrives twice, or the devices agree
_INTERVALS = 9  # of which five may be too long, because SYNCs were lost, and three too short, as they were read late


class DuplicateNodeWatch:
    """Follows one synchronous PDO of a node with transmission type 1 (CiA 301: sent once after each SYNC).

    A SYNC is doubled if a second PDO with different data arrives within two fifths of a SYNC period after the first.
    Frames that are lost or late do not look like this: after a lost SYNC the next PDO comes a whole period later, and a
    late PDO leaves a SYNC without one. A frame that is only repeated has the same data.

    Args:
        is_duplicate: an earlier watch has found a second device, and has not found it gone.

    Attributes:
        is_duplicate: five SYNCs more were doubled than had no PDO, and there have not been ten in a row with a single
            PDO since, nor a hundred in a row without different data.
    """

    def __init__(self, is_duplicate: bool = False) -> None:
        self.is_duplicate = is_duplicate
        self._sync: Sync | None = None  # that of the last PDO
        self._first: tuple[Stamp, bytes] | None = None  # the first PDO after it
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)  # of the last SYNCs with a PDO
        self._is_single = self._is_doubled = self._differs = False  # PDOs after it: one; two soon; two with other data
        self._doubled = self._single_in_a_row = self._alike_in_a_row = 0

    def feed(self, stamp: Stamp, sync: Sync | None, data: bytes) -> None:
        """Process a PDO.

        Args:
            stamp: when the PDO was received.
            sync: the last SYNC before it; None if there was none.
            data: its data.
        """
        if sync is None or stamp.is_doubtful or sync.stamp.is_doubtful:
            return
        if not 0 <= stamp.since(sync.stamp) <= SYNC_WINDOW_NS:
            return
        if self._sync is None or self._first is None or sync.number != self._sync.number:
            self._next(sync)
            self._first = stamp, data
            return
        self._is_single = False
        first, first_data = self._first
        self._differs |= data != first_data
        if data != first_data and not self._is_doubled and stamp.since(first) * 5 < self._period_ns() * 2:
            self._is_doubled = True
            self._doubled += 1
            self.is_duplicate |= self._doubled >= _FOUND_AFTER

    def is_silent(self, sync: Sync | None) -> bool:
        """Return True if the PDO has not arrived after any of the last SYNCs; False if it has never arrived."""
        return sync is not None and self._sync is not None and sync.number - self._sync.number > _AGREE_AFTER

    def _period_ns(self) -> int:
        """Return the period of SYNC by its last intervals; 0 before the first one."""
        return sorted(self._intervals_ns)[len(self._intervals_ns) // 3] if self._intervals_ns else 0

    def _next(self, sync: Sync) -> None:
        """Count the SYNC of the last PDO, and those without any since."""
        if self._sync is not None:
            self._single_in_a_row = self._single_in_a_row + 1 if self._is_single else 0
            self._doubled = max(self._doubled - (sync.number - self._sync.number - 1), 0)
            self._alike_in_a_row = 0 if self._differs else self._alike_in_a_row + 1
            if self._single_in_a_row >= _GONE_AFTER or self._alike_in_a_row >= _AGREE_AFTER:
                self._doubled = 0
                self.is_duplicate = False
        if sync.interval_ns is not None:
            self._intervals_ns.append(sync.interval_ns)
        self._sync = sync
        self._is_single, self._is_doubled, self._differs = True, False, False
