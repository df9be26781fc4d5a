"""One link's thread and its bounded queue; captures that do not fit are counted, and the loss is recorded.

The time from the start of the run until the link's port is open is recorded as a gap.
"""

from __future__ import annotations

import heapq
import logging
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import (
    CanCapture,
    DeviceEvent,
    EventKind,
    Gap,
    GapReason,
    LinkItem,
    LinkLoop,
    Record,
    SerialCapture,
)

log = logging.getLogger(__name__)

_LEVELS = {EventKind.LINK_UP: logging.INFO, EventKind.LINK_LOST: logging.WARNING}
RESTART_S = 1.0
LEFT_BEHIND_S = 10.0  # real seconds without reading after which a gap is recorded
_LEFT_BEHIND_NS = 2 * NS_PER_S  # shortest wait where time runs slowly: links update `read_until` once a second


@dataclass(slots=True)
class _Loss:
    """Captures lost since the queue was last drained, because it was full."""

    count: int
    first: Stamp
    last: Stamp


class LinkIntake:
    """Runs a link loop in its own thread, restarts it if it ends, and queues the items that it emits.

    Args:
        loop: the link.
        clock: clock for the delay and the stamp of a restart.
        limit: largest number of queued captures; events and gaps, being few, are always queued.
        begun: start of the run. From then, and from the end of a loop that ended, nothing is known of the link until
            its loop first reports the state of its port.
    """

    def __init__(self, loop: LinkLoop, clock: Clock, limit: int, begun: Stamp) -> None:
        self.name = loop.name
        self.dropped = 0
        self.restarts = 0
        self._loop, self._clock, self._limit = loop, clock, limit
        self._begun: Stamp | None = begun  # until the loop's first report
        self._behind: Stamp | None = None  # start of the recorded gap in which the link is not read
        self._behind_lock = threading.Lock()
        # Appends and pops of a deque are atomic: one thread emits, one drains, and only the loss needs a lock.
        self._queue: deque[LinkItem] = deque()
        self._loss: _Loss | None = None
        self._loss_lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def start(self, stop: threading.Event) -> None:
        """Start the thread; it ends soon after `stop` is set."""
        self._thread = threading.Thread(target=self._run, args=(stop,), name=f"link-{self.name}", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread's end for at most `timeout_s` seconds, after `stop` was set."""
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                log.error("link %s did not stop within %.1f s; stopping without it", self.name, timeout_s)

    @property
    def queued(self) -> int:
        """Number of queued items."""
        return len(self._queue)

    @property
    def read_until(self) -> Stamp | None:
        """Instant up to which all data received by the link's port are queued, or their loss is recorded.

        None if there is no limit, or if an open gap already records that the link is not read.
        """
        until = self._unread_since()
        return None if until == self._behind else until

    def _unread_since(self) -> Stamp | None:
        begun = self._begun
        return self._loop.read_until if begun is None else begun

    @property
    def unstored(self) -> int:
        """Number of queued captures, and of lost captures that are not recorded yet."""
        waiting = sum(isinstance(item, CanCapture | SerialCapture) for item in self._queue.copy())
        loss = self._loss
        return waiting + (loss.count if loss is not None else 0)

    def drain(self) -> list[LinkItem]:
        """Return the queued items, oldest first, followed by a gap for lost captures.

        A link that has not been read for long, because its loop hangs or ends repeatedly, gets a gap as well.
        """
        queue = self._queue
        items: list[LinkItem] = self._left_behind()  # before the loop's first report, which concerns the same gap
        items += [queue.popleft() for _ in range(len(queue))]
        if self._loss is not None:
            with self._loss_lock:
                loss, self._loss = self._loss, None
            text = f"{loss.count} captures lost: the queue to the store was full; check if the disk is full or too slow"
            items.append(DeviceEvent(self.name, loss.last, EventKind.FRAMES_DROPPED, text, loss.count))
            items.append(Gap(self.name, GapReason.FRAMES_LOST, loss.first, loss.last, loss.count))
        return items

    def _left_behind(self) -> list[LinkItem]:
        with self._behind_lock:
            now, since, behind = self._clock.now(), self._unread_since(), self._behind
            if behind is not None and since != behind:
                self._behind = None
                return [Gap(self.name, GapReason.LINK_DOWN, behind, since or now)]
            if since is None or behind is not None:
                return []
            until = self._loop.read_until
            if until is not None and until.since(since) > 0:
                return []  # the link is read, and its first report, which may be late in a log, is still to come
            waited_ns = now.since(since)
            if waited_ns < _LEFT_BEHIND_NS or self._clock.real_seconds(waited_ns / NS_PER_S) < LEFT_BEHIND_S:
                return []
            self._behind = since
            return [Gap(self.name, GapReason.LINK_DOWN, since)]

    def _end_of_start(self, begun: Stamp, item: LinkItem) -> None:
        """Record a gap from the start of the run, or from the end of a loop that ended, until the port is open."""
        with self._behind_lock:
            is_told = self._behind == begun
            first = _first_word(item) or (stamp_of(item) if is_told else None)
            if first is not None and (is_told or first.since(begun) > 0):
                self._queue.append(Gap(self.name, GapReason.LINK_DOWN, begun, first))
            self._begun = self._behind = None

    def _emit(self, item: LinkItem) -> None:
        if self._begun is not None:
            self._end_of_start(self._begun, item)
        if len(self._queue) < self._limit or not isinstance(item, CanCapture | SerialCapture):
            self._queue.append(item)
            return
        self.dropped += 1
        with self._loss_lock:
            if self._loss is None:
                self._loss = _Loss(1, item.stamp, item.stamp)
            else:
                self._loss.count += 1
                self._loss.last = item.stamp

    def _run(self, stop: threading.Event) -> None:
        while not stop.is_set():
            try:
                self._loop.run(self._emit, stop)
                reason = "it returned"
            except Exception as error:
                # A defect in one link must not end the others.
                log.exception("link %s: its loop failed", self.name)
                reason = f"{type(error).__name__}: {error}"
            if not stop.is_set():
                self.restarts += 1
                text = f"{self.name}: the loop that reads the link ended ({reason}); restarting it in {RESTART_S:g} s"
                now = self._clock.now()
                self._emit(DeviceEvent(self.name, now, EventKind.LINK_LOST, text))
                self._begun = self._loop.read_until or now
                self._clock.wait(stop, RESTART_S)


def stamp_of(record: LinkItem | Record) -> Stamp:
    """Return the stamp of a record, or the start of a gap."""
    return record.start if isinstance(record, Gap) else record.stamp


def tell_of_links(reports: Iterable[Record]) -> None:
    """Log the state of links, so that the service's journal shows why a rig is silent."""
    for report in reports:
        if isinstance(report, DeviceEvent) and report.kind in _LEVELS:
            log.log(_LEVELS[report.kind], "%s", report.text)


def in_time_order(queues: Iterable[Sequence[LinkItem]]) -> list[LinkItem]:
    """Return the items of all links in order of time, so that a batch covers one period; each link's order is kept."""

    def keyed(items: Sequence[LinkItem]) -> Iterator[tuple[int, LinkItem]]:
        newest_ns = -(2**63)
        for item in items:
            newest_ns = max(newest_ns, stamp_of(item).monotonic_ns)
            yield newest_ns, item

    return [item for _, item in heapq.merge(*map(keyed, queues), key=itemgetter(0))]


def _first_word(item: LinkItem) -> Stamp | None:
    """Return when a link first reports whether its port is open; None if it starts with other items, as in a replay."""
    if isinstance(item, Gap):
        return item.start if item.reason is GapReason.LINK_DOWN else None
    if isinstance(item, DeviceEvent) and item.kind in (EventKind.LINK_UP, EventKind.LINK_LOST):
        return item.stamp
    return None
