"""Notices for one target: kept in memory and in the store until they are delivered.

If the store cannot be written or a write hangs, notices are still sent, and their rows are written as soon as possible.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from daemon.monitoring.delivery import DeliveryError, Target
from daemon.monitoring.notice import Notice, Severity, message_of
from daemon.store.queries.notices import NoticeTable
from drivers.clock import NS_PER_S, Clock, Stamp, SystemClock

log = logging.getLogger(__name__)

HOUR_S = 3600.0
STALE_NS = 7 * 24 * 3600 * NS_PER_S  # pending notices older than this at start-up are not sent any more
WAITING_MAX = 1000  # pending notices in memory; older ones are only counted


@dataclass(frozen=True)
class Pace:
    """Pace at which messages are sent to a target, in real time.

    Attributes:
        gather_s: how long notices are collected for one message, as one fault often raises several alarms.
        first_retry_s: pause after a failed delivery; it doubles with each further failure.
        longest_retry_s: the longest pause.
        per_hour: most messages in an hour; further notices wait, and are sent in one message.
    """

    gather_s: float = 3.0
    first_retry_s: float = 10.0
    longest_retry_s: float = 900.0
    per_hour: int = 20


USUAL = Pace()


@dataclass
class _Entry:
    """A notice, its row id in the store (None until it is written), and when it was sent."""

    notice: Notice
    row: int | None = None
    sent: Stamp | None = None


class Outbox:
    """The notices of one target. One thread adds and sends them, and a second thread may call `write`.

    Args:
        target: delivers the notices.
        table: the store's table of notices.
        rig: name of the machine.
        clock: for times in the store.
        pace: how often messages are sent.
        least: lowest severity of alarms that are sent.
    """

    def __init__(
        self, target: Target, table: NoticeTable, rig: str, clock: Clock, pace: Pace, least: Severity = "warning"
    ) -> None:
        self.target = target
        self._table, self._rig, self._clock, self._pace, self._least = table, rig, clock, pace, least
        self._real = SystemClock()  # pauses are in real time; the rig's clock may run at a different rate
        now = clock.now()
        self._turn = threading.Lock()  # held while entries are moved or changed, never during a write or a delivery
        rows = table.waiting(target.name, now.utc_ns - STALE_NS, WAITING_MAX)
        self._waiting = [_Entry(_notice(row), row["id"]) for row in rows]
        # Alarms whose notices were sent or are pending, and that have not cleared
        self._uncleared = {notice.key: notice for notice in map(_notice, table.uncleared(target.name))}
        self._unlisted = 0
        self._unwritten: list[_Entry] = []  # sent, which is not yet in the store
        self._retry_s = pace.first_retry_s
        self._due_ns = self._real.monotonic_ns() if self._waiting else None
        hour_ago_ns = now.utc_ns - round(HOUR_S * NS_PER_S)
        ages = (now.utc_ns - utc_ns for utc_ns in table.sent_since(target.name, hour_ago_ns))
        self._sent_ns = deque(self._real.monotonic_ns() - max(age, 0) for age in ages)
        self._sent = self._failures = 0
        self._error: str | None = None

    # ---- pending notices ---------------------------------------------------------------------------------------------

    def reconcile(self, alarms: Sequence[Mapping[str, Any]], now: Stamp) -> None:
        """Add notices that were never queued because the daemon was killed, of active and of cleared alarms.

        Args:
            alarms: rows of the alarms that are active in the store.
            now: current time.
        """
        active = [_notice({**row, "event": "raised", "at": row["raised"]}) for row in alarms]
        for notice in active:
            uncleared = self._uncleared.get(notice.key)
            if uncleared is None or uncleared.raised != notice.raised:
                self.add(notice)
        keys = {notice.key for notice in active}
        for key, uncleared in list(self._uncleared.items()):
            if key not in keys:
                self.add(replace(uncleared, event="cleared", at=now))

    def add(self, notice: Notice) -> None:
        """Queue a notice, unless this target does not need it."""
        uncleared = self._uncleared.get(notice.key)
        if notice.event == "raised":
            if notice.severity != "critical" and self._least == "critical":
                return
            if uncleared is not None and (uncleared.raised, uncleared.severity) == (notice.raised, notice.severity):
                return
            self._uncleared[notice.key] = notice
        elif notice.event == "cleared":
            if uncleared is None:
                return
            del self._uncleared[notice.key]
        with self._turn:
            self._waiting.append(_Entry(notice))
            if len(self._waiting) > WAITING_MAX:
                del self._waiting[0]
                self._unlisted += 1
        if self._due_ns is None:
            self._due_ns = self._real.monotonic_ns() + round(self._pace.gather_s * NS_PER_S)

    # ---- store and target --------------------------------------------------------------------------------------------

    @property
    def is_written(self) -> bool:
        """True if all changes are in the store."""
        return not self._changes()

    def write(self) -> None:
        """Write all changes to the store; sqlite3.Error or StoreError if it cannot be written."""
        changes = self._changes()
        if not changes:
            return
        with self._table.transaction():
            for sent, row in {sent: row for _, row, sent in changes if row is not None and sent is not None}.items():
                self._table.mark_sent(self.target.name, row, sent)
            rows = [
                self._table.add(self.target.name, sent=sent, **vars(entry.notice)) if row is None else row
                for entry, row, sent in changes
            ]
        with self._turn:
            for (entry, _, _), row in zip(changes, rows, strict=True):
                entry.row = row
            del self._unwritten[: sum(sent is not None for _, _, sent in changes)]

    def _changes(self) -> list[tuple[_Entry, int | None, Stamp | None]]:
        """Return the entries that the store lacks, oldest first, as they are now: the entry, its row and when sent."""
        with self._turn:
            entries = [*self._unwritten, *self._waiting]
            return [(one, one.row, one.sent) for one in entries if one.row is None or one.sent is not None]

    def due_in_s(self) -> float | None:
        """Return the seconds until the next delivery attempt; None if nothing is pending."""
        if self._due_ns is None:
            return None
        now_ns = self._real.monotonic_ns()
        due_ns = self._due_ns
        hour_ns = round(HOUR_S * NS_PER_S)
        while self._sent_ns and self._sent_ns[0] <= now_ns - hour_ns:
            self._sent_ns.popleft()
        if len(self._sent_ns) >= self._pace.per_hour:
            due_ns = max(due_ns, self._sent_ns[-self._pace.per_hour] + hour_ns)
        return max(due_ns - now_ns, 0) / NS_PER_S

    def send(self) -> None:
        """Deliver all pending notices as one message; a failed delivery is retried later."""
        notices = [entry.notice for entry in self._waiting]
        try:
            self.target.deliver(message_of(self._rig, notices, self._unlisted))
        except Exception as error:  # an error of one message or target must not affect others
            self._failures += 1
            text = str(error) if isinstance(error, DeliveryError) else f"{type(error).__name__}: {error}"
            if text != self._error:
                is_defect = not isinstance(error, DeliveryError)
                log.warning(
                    "notices could not be delivered by %s and will be retried: %s",
                    self.target.name,
                    text,
                    exc_info=is_defect,
                )
            self._error = text
            self._due_ns = self._real.monotonic_ns() + round(self._retry_s * NS_PER_S)
            self._retry_s = min(2 * self._retry_s, self._pace.longest_retry_s)
            return
        now = self._clock.now()
        log.info("%d notices were delivered by %s", len(notices) + self._unlisted, self.target.name)
        with self._turn:
            for entry in self._waiting:
                entry.sent = now
            self._unwritten += self._waiting
            self._waiting = []
            self._unlisted = 0
        self._due_ns, self._error = None, None
        self._retry_s = self._pace.first_retry_s
        self._sent_ns.append(self._real.monotonic_ns())
        self._sent += 1

    def status(self) -> dict[str, Any]:
        """Return counts of messages sent and failed since the start, of pending notices, and the last error."""
        return {
            "target": self.target.name,
            "waiting": len(self._waiting) + self._unlisted,
            "sent": self._sent,
            "failures": self._failures,
            "error": self._error,
        }


def _notice(row: Mapping[str, Any]) -> Notice:
    return Notice(**{field.name: row[field.name] for field in fields(Notice)})
