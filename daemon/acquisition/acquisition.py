"""Acquisition: one thread per link, bounded queues, and a single writer thread.

The writer drains the queues, commits the raw captures, decodes them batch by batch, hands the records on, and commits
them together with what was concluded from them. Raw captures are always committed first, even while decoding is not
possible. A process that ends between the two commits leaves chunks marked as undecoded in the store; the next process
starts capturing at once, and decodes those chunks before its own (`daemon.acquisition.backlog`). A replay runs the same
writer without threads (`run_inline`).
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from daemon.acquisition.backlog import BATCH_CAPTURES, Backlog, Batch
from daemon.acquisition.clock_watch import ClockWatch
from daemon.acquisition.link_decoders import TICK_NS, LinkDecoders
from daemon.acquisition.link_intake import LinkIntake, in_time_order, stamp_of, tell_of_links
from daemon.acquisition.status.board import StatusBoard
from daemon.acquisition.status.present import NOTHING_EXPECTED, Expected
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.acquisition.thinning import Thinning
from daemon.store import Store
from daemon.store.errors import storage_sentence
from daemon.store.queries.device_states import device_states
from drivers.clock import NS_PER_S, Clock, Stamp, TimeBudget
from drivers.readings import (
    CanCapture,
    Capture,
    DecodeFailure,
    Decoder,
    DeviceEvent,
    LinkItem,
    LinkLoop,
    Record,
    SerialCapture,
)

log = logging.getLogger(__name__)

T = TypeVar("T")

ALIVE_NS = NS_PER_S
RETRY_S = 1.0
WRITE_HUNG_S = 4.0  # real seconds after which a write that has not ended is told
STOP_S = 15.0  # real seconds
LINKS_STOP_S = 5.0  # part of STOP_S for all links together, which check `stop` several times a second
LAST_RETRIES = 3  # when stopping, RETRY_S apart; then captures that could not be stored are lost, and counted
INLINE_CAPTURES = 4096
INLINE_SPAN_NS = NS_PER_S

# Faults of a record, not of the disk: out of a column's range or type, text that is not UTF-8.
_REFUSED = (sqlite3.IntegrityError, sqlite3.ProgrammingError, ArithmeticError, TypeError, ValueError)


class AcquisitionError(Exception):
    """Acquisition has failed in a way that only a restart can correct."""


class Acquisition:
    """Takes captures from links to stored records.

    Args:
        links: the link loops.
        decoders: link -> function that makes its decoder. A decoder is used within one boot: captures of a different
            boot, and those that a killed run left undecoded, get a fresh decoder. A link without a decoder is only
            captured.
        store: the database.
        clock: clock for ticks, lags and ages.
        batch_seconds: how long captures are gathered before they are committed, in real time; it limits how often the
            disk must sync.
        queue_captures: how many captures of one link may wait while the disk is slow.
        on_records: called in the writer thread with each batch of records once, before it is committed, and with an
            empty list when time has passed (ten times a second).
        also_store: called in the transaction that commits them, to store what `on_records` has concluded. If the disk
            refuses, it is called again; if the process ends before, the next start decodes the captures again.
        expected: devices from which data are expected, for `status`.
        clock_watch: detects steps of the computer's clock, live; None where a different clock is used.
        thinning: chooses the readings and fixes to store; all by default.
    """

    def __init__(
        self,
        links: Sequence[LinkLoop],
        decoders: Mapping[str, Callable[[], Decoder]],
        store: Store,
        clock: Clock,
        *,
        batch_seconds: float = 0.05,
        queue_captures: int = 200_000,
        on_records: Callable[[Sequence[Record]], None],
        also_store: Callable[[], None] = lambda: None,
        expected: Expected = NOTHING_EXPECTED,
        clock_watch: ClockWatch | None = None,
        thinning: Thinning | None = None,
    ) -> None:
        self._store, self._clock, self._on_records, self._also_store = store, clock, on_records, also_store
        # Asked once for each batch, and before consumers see it, who may then end a session.
        self._kept: Callable[[Sequence[Record]], Sequence[Record]] = list if thinning is None else thinning.kept
        self._batch_seconds = batch_seconds
        self._intakes = [LinkIntake(link, clock, queue_captures, store.begun or clock.now()) for link in links]
        self._factories = decoders
        self._decoding = self._new_decoding()
        self._backlog = Backlog(store, clock)
        self._is_left_over = False  # the captures being decoded are of an earlier run
        self._decoded: _Decoded | None = None
        self._next_tick_ns = 0
        self._unstored = 0  # captures that are drained but not committed
        self._troubles: dict[str, str] = {}
        self._board = StatusBoard(clock, expected)
        self._clock_watch = clock_watch
        self._stop_links = threading.Event()
        self._finish = threading.Event()
        self._decode_until = TimeBudget(0.0)  # when stopping
        self._writer: threading.Thread | None = None
        self._failure: Exception | None = None
        self._last_cycle_ns = clock.monotonic_ns()

    # ---- live ------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start capturing; captures that an earlier run left undecoded are decoded first, at the same time."""
        self._recall()
        self._last_cycle_ns = self._clock.monotonic_ns()
        for intake in self._intakes:
            intake.start(self._stop_links)
        self._writer = threading.Thread(target=self._write, name="writer", daemon=True)
        self._writer.start()

    def stop(self, budget: TimeBudget | None = None) -> bool:
        """Stop the links, store all their captures, and decode as many as time allows. Harmless when not started.

        Raw captures are stored first. Captures not decoded after half of the time are left to the next start.

        Args:
            budget: time limit, `STOP_S` by default. Captures not stored by then are counted, logged and reported by
                `check`.

        Returns:
            True if the writer has ended; False if it hangs in a commit and still holds the store.
        """
        budget = budget or TimeBudget(STOP_S)
        self._stop_links.set()
        links = TimeBudget(min(LINKS_STOP_S, budget.left_s / 3))
        for intake in self._intakes:
            intake.join(links.left_s)
        self._decode_until = TimeBudget(budget.left_s / 2)
        self._finish.set()
        if self._writer is None:
            return True
        self._writer.join(budget.left_s)
        if self._writer.is_alive():
            log.critical("%s: a write does not finish; stopping without it", self._store.path)
        lost = self._unstored + sum(intake.unstored for intake in self._intakes)
        if lost:
            self._fail(f"{lost} captures could not be stored before the shutdown")
        elif self._decoded is not None or not self._backlog.is_empty:
            log.warning("all captures are stored; the next start decodes those that are not decoded yet")
        return not self._writer.is_alive()

    def _fail(self, why: str) -> None:
        log.critical("%s", why)
        self._failure = AcquisitionError(why)

    def status(self) -> AcquisitionStatus:
        """Return a snapshot; may be called from any thread."""
        summaries = self._decoding.summaries(self._clock.now())
        return self._board.snapshot(
            self._intakes,
            summaries,
            self._decoding.defects(),
            is_behind=self.is_behind,
            is_write_hung=self._writer is not None and not self.alive(WRITE_HUNG_S),
        )

    @property
    def is_behind(self) -> bool:
        """True while captures wait in the store to be decoded, as after a kill: readings and fixes are late."""
        return self._backlog.is_behind

    def check(self) -> None:
        """Raise if acquisition has failed; a full or slow disk is not a failure, because writes are retried.

        Raises:
            AcquisitionError: the writer has ended by itself, or captures were discarded when stopping.
        """
        if self._failure is not None:
            raise AcquisitionError(f"nothing is stored any more: {self._failure}")

    @property
    def has_stored_all(self) -> bool:
        """False once captures were lost because the store could not be written."""
        return self._failure is None

    def alive(self, within_s: float) -> bool:
        """Return True if the writer is alive and has completed a cycle within the last `within_s` real seconds."""
        since_s = (self._clock.monotonic_ns() - self._last_cycle_ns) / NS_PER_S
        return self._writer is not None and self._writer.is_alive() and self._clock.real_seconds(since_s) <= within_s

    def _write(self) -> None:
        next_alive_ns = 0
        try:
            while not self._finish.is_set():
                now = self._clock.now()
                self._last_cycle_ns = now.monotonic_ns
                read_until = self._take_in(now)
                if now.monotonic_ns >= next_alive_ns:
                    self._note_alive(read_until)
                    next_alive_ns = now.monotonic_ns + ALIVE_NS
                is_done = self._decode_next(now)
                if not is_done:
                    self._finish.wait(RETRY_S)
                elif self._backlog.is_empty:
                    self._finish.wait(self._batch_seconds)
            self._note_alive(self._take_in(self._clock.now()))
            tries_left = LAST_RETRIES
            while (
                tries_left and not self._decode_until.is_over and not (self._backlog.is_empty and self._decoded is None)
            ):
                if not self._decode_next(self._clock.now()):
                    tries_left -= 1
                    time.sleep(min(RETRY_S, self._decode_until.left_s))
        except Exception as error:
            why = storage_sentence(self._store.path, error) if isinstance(error, sqlite3.DatabaseError) else None
            log.critical("the writer failed; nothing is stored any more: %s", why or error, exc_info=why is None)
            self._board.set_error(f"the writer failed: {error}; restart rigcal")
            self._failure = error

    def _note_alive(self, until: Stamp) -> None:
        self._try("the heartbeat", partial(self._store.note_alive, until))

    def _take_in(self, now: Stamp) -> Stamp:
        """Commit the links' captures, and wait while the disk is full or faulty; captures queue meanwhile.

        Returns:
            Instant up to which all data received by the ports, or their loss, are committed.
        """
        links = [intake.read_until for intake in self._intakes]  # read before the queues are drained
        read_until = min([now, *filter(None, links)], key=lambda stamp: stamp.monotonic_ns)
        queues = [intake.drain() for intake in self._intakes]
        if self._clock_watch is not None and (step := self._clock_watch.look(self._clock.now())) is not None:
            queues.append([step])
        items = [item for queue in queues for item in queue]
        if not items:
            return read_until
        if len(items) > BATCH_CAPTURES:
            items = in_time_order(queues)
        self._unstored = sum(isinstance(item, CanCapture | SerialCapture) for item in items)
        batches = self._insist(partial(self._store.despite_damage, partial(self._commit_raw, items)))
        self._unstored = 0
        for batch in batches:
            self._board.captured(batch.captures)
            self._backlog.add(batch)
            tell_of_links(batch.reports)
        return read_until

    def _decode_next(self, now: Stamp) -> bool:
        """Decode one batch, and pass the time to the decoders if no batch is left; store the records.

        Returns:
            False if the disk refuses, and the call must be repeated.
        """
        if self._decoded is None and not self._try("decoded records", partial(self._decode, now)):
            return False
        if (decoded := self._decoded) is None:
            return True
        commit = partial(self._commit_records, decoded.records, decoded.chunk_ids)
        if not self._try("decoded records", partial(self._store.despite_damage, commit)):
            return False
        self._decoded = None
        if not self._is_left_over:  # records of an earlier run do not show the present state
            self._board.recorded(decoded.told, decoded.until)
        return True

    def _decode(self, now: Stamp) -> None:
        waiting = self._backlog.first()
        is_tick = now.monotonic_ns >= self._next_tick_ns
        if waiting is None and not is_tick:
            return
        is_left_over = waiting is not None and waiting.is_left_over
        if is_left_over != self._is_left_over:
            self._tell_of_left_overs(is_left_over=is_left_over)
        batch = waiting or Batch((), ())
        records = [*batch.failures, *self._decoding.feed(batch.captures)]
        if waiting is not None:
            self._backlog.remove(waiting)
        until = _end(batch.captures)
        # Decoders are told the time only after they have been given all captures up to it.
        if is_tick and self._backlog.is_empty and not is_left_over:
            records += self._decoding.tick(now)
            self._next_tick_ns = now.monotonic_ns + TICK_NS
            until = now
        self._decoded = _Decoded(batch.chunk_ids, self._kept(records), [*batch.reports, *records], until)
        self._hand_on(self._decoded.told)

    def _tell_of_left_overs(self, *, is_left_over: bool) -> None:
        if is_left_over:
            log.warning("decoding captures that the last run left undecoded")
        else:
            self._decoding = self._new_decoding()  # live captures are decoded separately from those left over
            self._recall()
            log.info("all captures of the last run are decoded")
        self._is_left_over = is_left_over

    def _new_decoding(self) -> LinkDecoders:
        """Return decoders that start from the stored states of the devices."""
        return LinkDecoders(self._factories, self._states)

    def _recall(self) -> None:
        """Start the decoders from the devices' states before this run, and show these states."""
        self._board.recall(self._decoding.begin(self._clock.now()))

    def _states(self, before: Stamp) -> Sequence[DeviceEvent]:
        return self._store.events(partial(device_states, self._store, before))

    # ---- replay ----------------------------------------------------------------------------------------------------

    def run_inline(self, items: Iterable[LinkItem]) -> None:
        """Store and decode `items`, in order, as fast as possible, in this thread.

        Time is taken from the captures' stamps, so that the same items always give the same rows.

        Raises:
            sqlite3.Error, StoreError: the store cannot be written.
        """
        batch: list[LinkItem] = []
        starts_ns = 0
        for item in items:
            now_ns = stamp_of(item).monotonic_ns
            if batch and (len(batch) >= INLINE_CAPTURES or not 0 <= now_ns - starts_ns < INLINE_SPAN_NS):
                self._store_inline(batch)
                batch = []
            if not batch:
                starts_ns = now_ns
            batch.append(item)
        if batch:
            self._store_inline(batch)

    def _store_inline(self, items: Sequence[LinkItem]) -> None:
        for batch in self._commit_raw(items):
            self._board.captured(batch.captures)
            tell_of_links(batch.reports)
            records = self._decoding.feed_and_tick(batch.captures)
            kept, told = self._kept(records), [*batch.reports, *records]
            self._hand_on(told)
            self._commit_records(kept, batch.chunk_ids)
            self._board.recorded(told, _end(batch.captures))

    # ---- the writer's work -----------------------------------------------------------------------------------------

    def _commit_raw(self, items: Sequence[LinkItem]) -> list[Batch]:
        batches = []
        with self._store.transaction():
            for start in range(0, len(items), BATCH_CAPTURES):
                captures: list[Capture] = []
                reports: list[Record] = []
                for item in items[start : start + BATCH_CAPTURES]:
                    if isinstance(item, CanCapture | SerialCapture):
                        captures.append(item)
                    else:
                        reports.append(item)
                self._insert(reports)
                batches.append(Batch(self._store.append_captures(captures), captures, reports))
        return batches

    def _commit_records(self, records: Sequence[Record], chunk_ids: Sequence[int]) -> None:
        with self._store.transaction():
            self._insert(records)
            self._store.mark_decoded(chunk_ids)
            self._also_store()

    def _insert(self, records: Sequence[Record]) -> None:
        """Insert records; a record that the store refuses is replaced by a decode failure and blocks no others."""
        try:
            self._store.insert_records(records)
        except _REFUSED as error:
            if len(records) == 1:
                log.exception("a record cannot be stored: %r", records[0])
                reason = f"a {type(records[0]).__name__} cannot be stored: {str(error)!a}"
                self._store.insert_records([DecodeFailure("store", stamp_of(records[0]), reason, b"")])
                return
            for record in records:
                self._insert([record])

    def _hand_on(self, records: Sequence[Record]) -> None:
        try:
            self._on_records(records)
        except Exception:
            # A fault of their consumer must neither end acquisition nor keep the records from being stored.
            log.exception("records could not be processed further; they are stored")

    def _insist(self, work: Callable[[], T]) -> T:
        """Repeat `work` until the disk accepts it, and return its result; when stopping, retry only a few times."""
        tries_left = LAST_RETRIES
        while True:
            try:
                result = work()
            except sqlite3.DatabaseError as error:
                self._note_trouble("captures", error)
                if self._finish.wait(RETRY_S):
                    if not tries_left or self._decode_until.is_over:
                        raise
                    tries_left -= 1
                    time.sleep(min(RETRY_S, self._decode_until.left_s))
                self._last_cycle_ns = self._clock.monotonic_ns()
            else:
                self._note_trouble("captures", None)
                return result

    def _try(self, what: str, work: Callable[[], None]) -> bool:
        """Try `work` once and return True if the disk accepts it; otherwise captures are stored before a retry."""
        try:
            work()
        except sqlite3.DatabaseError as error:
            self._note_trouble(what, error)
            return False
        self._note_trouble(what, None)
        return True

    def _note_trouble(self, what: str, error: sqlite3.DatabaseError | None) -> None:
        if error is None:
            if self._troubles.pop(what, None) is None:
                return
            log.warning("%s: %s can be written again", self._store.path, what)
        else:
            sentence = storage_sentence(self._store.path, error)
            if what not in self._troubles:
                log.error("%s cannot be written; retrying: %s", what, sentence)
            self._troubles[what] = sentence
        self._board.set_error(next(iter(self._troubles.values()), None))


@dataclass(frozen=True)
class _Decoded:
    """A decoded batch that is not stored yet: its chunks, its records, these with its links' reports, and its end."""

    chunk_ids: Sequence[int]
    records: Sequence[Record]
    told: Sequence[Record]
    until: Stamp | None


def _end(captures: Sequence[Capture]) -> Stamp | None:
    return captures[-1].stamp if captures else None
