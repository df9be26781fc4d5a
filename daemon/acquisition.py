"""Acquisition: one thread per link, bounded queues, and the one thread that writes.

The writer drains the queues, commits the raw captures, decodes them, commits the records, and hands them on. A process
killed between the two commits leaves chunks that the store knows as undecoded; the next start decodes them before it
goes live. A replay runs the same writer without threads (`run_inline`).
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TypeVar

from daemon.acquisition_status import AcquisitionStatus, StatusBoard
from daemon.link_intake import LinkIntake
from daemon.store import Store, StoreError
from drivers.can_decoder import CanDecoder
from drivers.can_summary import CanSummary
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import (
    CanCapture,
    Capture,
    DecodeFailure,
    Decoder,
    DeviceEvent,
    EventKind,
    Gap,
    LinkItem,
    LinkLoop,
    Record,
    SerialCapture,
)

log = logging.getLogger(__name__)

T = TypeVar("T")

TICK_NS = NS_PER_S // 10
ALIVE_NS = 5 * NS_PER_S
RETRY_S = 1.0
LAST_RETRIES = 3  # when stopping; then what could not be stored is given up, and the log says how much
INLINE_CAPTURES = 4096
INLINE_SPAN_NS = NS_PER_S

# What is wrong with a record, in place of with the disk: out of a column's range or type, text that is no UTF-8.
_REFUSED = (sqlite3.IntegrityError, sqlite3.ProgrammingError, ArithmeticError, TypeError, ValueError)

_LINK_LEVELS = {EventKind.LINK_UP: logging.INFO, EventKind.LINK_LOST: logging.WARNING}


class AcquisitionError(Exception):
    """Acquisition has failed in a way that only a new start can mend."""


class Acquisition:
    """Takes captures from links to stored records.

    Args:
        links: the link loops.
        decoders: for each link, what makes its decoder. A decoder lives within one boot: captures of another boot,
            and those that a killed run left undecoded, get a fresh one. A link without a decoder is only captured.
        store: where everything goes.
        clock: for ticks, lags and ages.
        batch_seconds: how long captures are gathered before they are committed, in real time: it bounds how often
            the disk must sync.
        queue_captures: how many captures of one link may wait while the disk is slow.
        on_records: called in the writer's thread, within a transaction of its own, with records after they were
            committed, and with none when time has passed (ten times a second).
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
    ) -> None:
        self._store, self._clock, self._on_records = store, clock, on_records
        self._batch_seconds = batch_seconds
        self._intakes = [LinkIntake(link, clock, queue_captures, store.begun or clock.now()) for link in links]
        self._factories = decoders
        self._decoding = _Decoding(decoders)
        self._board = StatusBoard(clock)
        self._stop_links = threading.Event()
        self._finish = threading.Event()
        self._writer: threading.Thread | None = None
        self._failure: Exception | None = None
        self._last_cycle_ns = clock.monotonic_ns()

    # ---- live ------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Decode what a killed run left behind, then go live.

        Raises:
            sqlite3.Error: the store cannot be written to.
        """
        self._recover()
        self._decoding = _Decoding(self._factories)
        self._last_cycle_ns = self._clock.monotonic_ns()
        for intake in self._intakes:
            intake.start(self._stop_links)
        self._writer = threading.Thread(target=self._write, name="writer", daemon=True)
        self._writer.start()

    def stop(self) -> None:
        """Stop the links, store all that they have captured, stop the writer. Harmless when not started."""
        self._stop_links.set()
        for intake in self._intakes:
            intake.join()
        self._finish.set()
        if self._writer is not None:
            self._writer.join()

    def status(self) -> AcquisitionStatus:
        """A snapshot, from any thread."""
        return self._board.snapshot(self._intakes, self._decoding.summaries(self._clock.now()))

    def check(self) -> None:
        """Whether the writer lives; a disk that is full or slow is no reason to raise, it is waited for.

        Raises:
            AcquisitionError: the writer has ended, and nothing is stored any more.
        """
        if self._failure is not None:
            raise AcquisitionError(f"the writer failed, nothing is stored any more: {self._failure}")

    def alive(self, within_s: float) -> bool:
        """Whether the writer has gone round within the last real `within_s`: a hung disk or a dead writer has not."""
        since_s = (self._clock.monotonic_ns() - self._last_cycle_ns) / NS_PER_S
        return self._writer is not None and self._writer.is_alive() and self._clock.real_seconds(since_s) <= within_s

    def _write(self) -> None:
        next_tick_ns = next_alive_ns = 0
        finished = False
        try:
            while not finished:
                finished = self._finish.is_set()  # before draining: nothing comes after it
                now = self._clock.now()
                self._last_cycle_ns = now.monotonic_ns
                items = [item for intake in self._intakes for item in intake.drain()]
                if now.monotonic_ns >= next_tick_ns:
                    self._store_batch(items, partial(self._decoding.feed_until, now=now))
                    next_tick_ns = now.monotonic_ns + TICK_NS
                elif items:
                    self._store_batch(items, self._decoding.feed)
                if now.monotonic_ns >= next_alive_ns:
                    self._insist(partial(self._store.note_alive, now))
                    next_alive_ns = now.monotonic_ns + ALIVE_NS
                if not finished:
                    self._finish.wait(self._batch_seconds)
        except Exception as error:
            # The thread ends here; `alive` and `status` tell.
            log.critical("the writer failed; nothing is stored any more", exc_info=error)
            self._board.set_error(f"the writer failed: {error}; restart rigcal")
            self._failure = error

    def _recover(self) -> None:
        now = self._clock.now()
        waiting = self._store.undecoded_chunks()
        if waiting:
            log.warning("decoding %d chunks that a killed run left behind", len(waiting))
        for chunk_id in waiting:
            try:
                records = self._decoding.feed(self._store.chunk_captures(chunk_id))
            except StoreError as error:
                log.exception("a chunk cannot be decoded")
                records = [DecodeFailure("store", now, str(error), b"")]
            self._commit_records(records, [chunk_id])
            self._hand_on(records)

    # ---- replay ----------------------------------------------------------------------------------------------------

    def run_inline(self, items: Iterable[LinkItem]) -> None:
        """Store and decode `items`, in order, as fast as it goes, in this thread.

        Time is what the captures' stamps say, so the same items give the same rows, whatever the machine does.

        Raises:
            sqlite3.Error, StoreError: the store cannot be written to.
        """
        batch: list[LinkItem] = []
        starts_ns = 0
        for item in items:
            now_ns = _stamp(item).monotonic_ns
            if batch and (len(batch) >= INLINE_CAPTURES or not 0 <= now_ns - starts_ns < INLINE_SPAN_NS):
                self._store_batch(batch, self._decoding.feed_and_tick)
                batch = []
            if not batch:
                starts_ns = now_ns
            batch.append(item)
        if batch:
            self._store_batch(batch, self._decoding.feed_and_tick)

    # ---- the writer's work -----------------------------------------------------------------------------------------

    def _store_batch(self, items: Sequence[LinkItem], decode: Callable[[Sequence[Capture]], list[Record]]) -> None:
        captures: list[Capture] = []
        reports: list[Record] = []
        for item in items:
            if isinstance(item, CanCapture | SerialCapture):
                captures.append(item)
            else:
                reports.append(item)
        chunk_ids: list[int] = []
        if items:
            chunk_ids = self._insist(lambda: self._commit_raw(captures, reports))
        self._board.captured(captures)
        _tell_of_links(reports)
        records = decode(captures)
        if records or chunk_ids:
            self._insist(lambda: self._commit_records(records, chunk_ids))
        self._hand_on(reports + records)

    def _commit_raw(self, captures: Sequence[Capture], reports: Sequence[Record]) -> list[int]:
        with self._store.transaction():
            self._insert(reports)
            return self._store.append_captures(captures)

    def _commit_records(self, records: Sequence[Record], chunk_ids: Sequence[int]) -> None:
        with self._store.transaction():
            self._insert(records)
            self._store.mark_decoded(chunk_ids)

    def _insert(self, records: Sequence[Record]) -> None:
        """Insert records; one that the store refuses must not keep the others out, nor come again at every start."""
        try:
            self._store.insert_records(records)
        except _REFUSED as error:
            if len(records) == 1:
                log.exception("a record cannot be stored: %r", records[0])
                reason = f"a {type(records[0]).__name__} cannot be stored: {str(error)!a}"
                self._store.insert_records([DecodeFailure("store", _stamp(records[0]), reason, b"")])
                return
            for record in records:
                self._insert([record])

    def _hand_on(self, records: Sequence[Record]) -> None:
        self._board.recorded(records)
        try:
            with self._store.transaction():
                self._on_records(records)
        except Exception:
            # The records are stored; a fault of their consumer must not end acquisition.
            log.exception("records are stored, but could not be handed on")

    def _insist(self, work: Callable[[], T]) -> T:
        """What `work` returns, however long the disk is full or faulty; meanwhile captures queue.

        In a replay, and after the last retries when stopping, the error goes to the caller.
        """
        tries = 0
        while True:
            try:
                result = work()
            except sqlite3.DatabaseError as error:
                tries += 1
                if self._writer is None or (self._finish.is_set() and tries > LAST_RETRIES):
                    raise
                if tries == 1:
                    log.error("%s cannot be written (%s); captures wait and are tried again", self._store.path, error)
                self._board.set_error(f"{self._store.path} cannot be written: {error}; free space or check the disk")
                self._finish.wait(RETRY_S)
                self._last_cycle_ns = self._clock.monotonic_ns()
            else:
                if tries:
                    log.warning("%s can be written again", self._store.path)
                    self._board.set_error(None)
                return result


def _tell_of_links(reports: Iterable[Record]) -> None:
    """A rig that is silent must say why in the service's journal, where people look first."""
    for report in reports:
        if isinstance(report, DeviceEvent) and report.kind in _LINK_LEVELS:
            log.log(_LINK_LEVELS[report.kind], "%s", report.text)


class _Decoding:
    """The decoders of all links, each within one boot."""

    def __init__(self, factories: Mapping[str, Callable[[], Decoder]]) -> None:
        self._factories = factories
        self._decoders: dict[str, Decoder] = {}
        self._boots: dict[str, str] = {}
        self._defective: set[str] = set()
        self._ticked_ns = -TICK_NS

    def feed(self, captures: Sequence[Capture]) -> list[Record]:
        """Records of captures, in their order."""
        records: list[Record] = []
        link = boot = None
        decoder: Decoder | None = None
        for capture in captures:
            if capture.link != link or capture.stamp.boot_id != boot:
                link, boot = capture.link, capture.stamp.boot_id
                decoder = self._decoder(link, boot) if link in self._factories else None
            if decoder is None:
                continue
            try:
                produced = decoder.feed(capture)
            except Exception as error:  # noqa: BLE001 - see _failure
                produced = [self._failure(capture.link, capture.stamp, error, capture.data)]
            if produced:
                records.extend(produced)
        return records

    def feed_until(self, captures: Sequence[Capture], now: Stamp) -> list[Record]:
        """Records of captures and of the time that has passed until `now`."""
        return self.feed(captures) + self.tick(now)

    def feed_and_tick(self, captures: Sequence[Capture]) -> list[Record]:
        """Records of captures and of the time that passes by their stamps."""
        records: list[Record] = []
        start = 0
        for i, capture in enumerate(captures):
            if not 0 <= capture.stamp.monotonic_ns - self._ticked_ns < TICK_NS:
                records += self.feed(captures[start:i])
                records += self.tick(capture.stamp)
                start, self._ticked_ns = i, capture.stamp.monotonic_ns
        return records + self.feed(captures[start:])

    def tick(self, now: Stamp) -> list[Record]:
        """Records that time causes, at decoders that live in the boot of `now`."""
        records: list[Record] = []
        for link in self._factories:
            if self._boots.setdefault(link, now.boot_id) != now.boot_id:
                continue
            try:
                records.extend(self._decoder(link, now.boot_id).tick(now))
            except Exception as error:  # noqa: BLE001 - see _failure
                records.append(self._failure(link, now, error, b""))
        return records

    def summaries(self, now: Stamp) -> list[CanSummary]:
        """What the CAN links have heard until `now`; from any thread."""
        decoders = [self._decoders.get(link) for link in self._factories]
        return [decoder.summary(now) for decoder in decoders if isinstance(decoder, CanDecoder)]

    def _failure(self, link: str, stamp: Stamp, error: Exception, raw: bytes) -> DecodeFailure:
        """A decoder never raises by contract; a defect in one must not end acquisition, nor flood the log."""
        if link not in self._defective:
            self._defective.add(link)
            log.critical("link %s: its decoder is defective; captures are kept", link, exc_info=error)
        return DecodeFailure(link, stamp, f"the decoder failed: {type(error).__name__}: {error}", raw)

    def _decoder(self, link: str, boot: str) -> Decoder:
        if link not in self._decoders or self._boots[link] != boot:
            self._decoders[link], self._boots[link] = self._factories[link](), boot
        return self._decoders[link]


def _stamp(record: LinkItem | Record) -> Stamp:
    return record.start if isinstance(record, Gap) else record.stamp
