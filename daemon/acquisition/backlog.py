"""Captures that are stored and wait to be decoded.

The store's `undecoded_chunks` lists all of them, so a stop, a kill or a slow decoder loses nothing. The newest captures
are also kept in memory, which saves reading them back. Captures left by an earlier run, and captures beyond the limit
of the memory, are read from the store.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from daemon.store import Store, StoreError
from drivers.clock import Clock
from drivers.readings import Capture, DecodeFailure, Record

BATCH_CAPTURES = 4096  # most captures decoded and stored at once; a stop and the watchdog wait for one batch
HELD_CAPTURES = 50_000  # most captures held in memory


@dataclass(frozen=True)
class Batch:
    """Captures that are decoded together.

    Attributes:
        chunk_ids: the chunks that hold them.
        captures: their captures, each link's in order.
        reports: records that the links themselves reported at the same time; already stored.
        failures: failures of chunks that cannot be read.
        is_left_over: an earlier run captured them.
    """

    chunk_ids: Sequence[int]
    captures: Sequence[Capture]
    reports: Sequence[Record] = ()
    failures: Sequence[Record] = ()
    is_left_over: bool = False


class Backlog:
    """Captures that wait to be decoded, oldest first. For the writer thread only.

    Args:
        store: store of the captures.
        clock: clock for the instants at which chunks are found to be damaged.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._batches: deque[Batch] = deque()
        self._held = 0
        self._reports: list[Record] = []  # reports of batches that are not in memory
        self._last_id = 0  # chunks up to this id have been removed
        self._left_over_until = store.newest_undecoded()
        self._is_in_store = self._left_over_until > 0

    @property
    def is_behind(self) -> bool:
        """True while some captures are in the store only."""
        return self._is_in_store

    @property
    def is_empty(self) -> bool:
        """True when all stored captures have been removed."""
        return not self._batches and not self._is_in_store

    def add(self, batch: Batch) -> None:
        """Add a stored batch behind all others."""
        if self._is_in_store or self._held + len(batch.captures) > HELD_CAPTURES:
            self._is_in_store = True
            self._reports += batch.reports
            return
        self._batches.append(batch)
        self._held += len(batch.captures)

    def first(self) -> Batch | None:
        """Return the oldest batch, which stays until it is removed; None if there is none.

        Raises:
            sqlite3.OperationalError: the disk cannot be read at present.
        """
        if self._batches:
            return self._batches[0]
        if not self._is_in_store:
            return None
        batch = self._read()
        if not batch.chunk_ids and not batch.reports:
            self._is_in_store = False
            return None
        return batch

    def remove(self, batch: Batch) -> None:
        """Remove the batch that `first` has returned last, because it is decoded."""
        if self._batches:
            self._held -= len(self._batches.popleft().captures)
        elif not batch.chunk_ids:
            self._is_in_store, self._reports = False, []
        self._last_id = max([self._last_id, *batch.chunk_ids])

    def _read(self) -> Batch:
        ids = self._store.undecoded_chunks(self._last_id, BATCH_CAPTURES)
        is_left_over = bool(ids) and ids[0] <= self._left_over_until
        if is_left_over:
            ids = [chunk_id for chunk_id in ids if chunk_id <= self._left_over_until]
        captures: list[Capture] = []
        failures: list[Record] = []
        for chunk_id in ids:
            try:
                captures += self._store.chunk_captures(chunk_id)
            except StoreError as error:
                failures.append(DecodeFailure("store", self._clock.now(), str(error), b""))
        # Reports of links are current: they are returned with the current captures, after all that were left over.
        return Batch(ids, captures, () if ids else tuple(self._reports), failures, is_left_over)
