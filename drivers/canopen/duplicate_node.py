"""Finds a second device with the number of a node, by the PDOs of both: a node sends its PDO once after a SYNC."""

from __future__ import annotations

from drivers.canopen.sync import SYNC_WINDOW_NS, Sync
from drivers.clock import NS_PER_S, Stamp

_ALLOWED = 1.2  # PDOs per SYNC; more than one, as SYNCs may be lost
_LEAST_EXCESS = 6.0
_BATCH_NS = NS_PER_S // 5  # an adapter may hold PDOs back for as long
_MARGIN = 1.2  # of the PDOs that an adapter may hold back
_PAUSE = 10  # usual periods of SYNC
_WINDOW_SYNCS = 20
_WINDOW_NS = NS_PER_S // 2


class DuplicateNodeWatch:
    """Follows one synchronous PDO of a node with transmission type 1 (CiA 301: sent once after each SYNC).

    PDOs are counted by SYNCs, not by time, because an adapter may deliver several of both at once. A PDO with the same
    data as the one before, after the same SYNC, is not counted: it may be repeated, and equal values do no harm.

    A second device is found by a cumulative sum: each PDO adds 1, each SYNC subtracts 1.2, and the sum is never below
    zero. The sum of two devices is enough after eight SYNCs, or after 0.3 s if SYNC is faster; that of one device whose
    PDOs arrive in batches is not. A device is taken to be alone again if 20 SYNCs or more, over half a second or more,
    have at most 1.2 PDOs each. A window in which either of them pauses shows nothing. More than every sixth SYNC must
    not be lost. In the first half second nothing is found, as the rate of SYNC is unknown.

    Args:
        is_duplicate: an earlier watch has found a second device, and has not found it gone.

    Attributes:
        is_duplicate: there are two devices.
    """

    def __init__(self, is_duplicate: bool = False) -> None:
        self.is_duplicate = is_duplicate
        self._sync: Sync | None = None  # that of the last PDO
        self._data: bytes | None = None  # of the last PDO
        self._excess = 0.0
        self._enough: float | None = None  # None until the rate of SYNC is known
        self._period_ns: float | None = None  # of SYNC
        self._since: Sync  # first SYNC of the window
        self._counted = 0  # PDOs in the window

    def feed(self, stamp: Stamp, sync: Sync | None, data: bytes) -> None:
        """Process a PDO.

        Args:
            stamp: when the PDO was received.
            sync: the last SYNC before it; None if there was none.
            data: its data.
        """
        if sync is None or not 0 <= stamp.since(sync.stamp) <= SYNC_WINDOW_NS:
            return  # not sent because of a SYNC
        if self._sync is None:
            self._since = self._sync = sync
        self._excess = max(self._excess - _ALLOWED * (sync.number - self._sync.number), 0.0)
        if self._has_paused(self._sync, sync):
            self._since, self._counted = sync, 0
        self._end_window(sync)
        if data != self._data or sync.number != self._sync.number:
            self._excess += 1.0
            self._counted += 1
        self._sync, self._data = sync, data
        self.is_duplicate |= self._enough is not None and self._excess >= self._enough

    def is_silent(self, sync: Sync | None) -> bool:
        """Return True if the PDO has not arrived after any of the last SYNCs; False if it has never arrived."""
        return sync is not None and self._sync is not None and sync.number - self._sync.number > 2 * _WINDOW_SYNCS

    def _has_paused(self, last: Sync, sync: Sync) -> bool:
        """Return True if PDOs or SYNCs were missing for longer than an adapter holds them back."""
        syncs, elapsed_ns = sync.number - last.number, sync.stamp.since(last.stamp)
        if elapsed_ns <= _BATCH_NS:
            return False
        return syncs > 1 or (self._period_ns is not None and elapsed_ns > _PAUSE * self._period_ns)

    def _end_window(self, sync: Sync) -> None:
        """Measure the rate of SYNC, and end the window at a SYNC if it has enough of them: judge its PDOs."""
        syncs, elapsed_ns = sync.number - self._since.number, sync.stamp.since(self._since.stamp)
        if elapsed_ns < _WINDOW_NS:
            return
        self._period_ns = elapsed_ns / syncs
        self._enough = max(_LEAST_EXCESS, _MARGIN * _BATCH_NS / self._period_ns)
        if syncs < _WINDOW_SYNCS:
            return
        if self._counted <= _ALLOWED * syncs:
            self.is_duplicate = False
            self._excess = 0.0
        self._since, self._counted = sync, 0
