"""Notices for one target: kept in memory and in the store until they were delivered.

A notice shows that it waits although the store cannot be written: it is sent all the same, and its row is written once
it can be.
"""

from __future__ import annotations

import logging
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
STALE_NS = 7 * 24 * 3600 * NS_PER_S  # nobody needs to be told any more of what is older when rigcal starts
WAITING_MAX = 1000  # in memory; older ones are counted


@dataclass(frozen=True)
class Pace:
    """Pace at which a target is told, in real time.

    Attributes:
        gather_s: what is to be told is gathered for so long: one fault often raises several alarms.
        first_retry_s: pause after a delivery that failed; it doubles with every further one.
        longest_retry_s: the longest pause.
        per_hour: how many messages an hour at most; what comes beyond waits, and is told in one.
    """

    gather_s: float = 3.0
    first_retry_s: float = 10.0
    longest_retry_s: float = 900.0
    per_hour: int = 20


USUAL = Pace()


@dataclass
class _Entry:
    """A notice, and its number in the store; None while it is not written."""

    notice: Notice
    row: int | None = None


class Outbox:
    """The notices of one target. Belongs to one thread.

    Args:
        target: where they go.
        table: of the store.
        rig: name of the machine.
        clock: of the store's instants.
        pace: how often messages are sent.
        least: alarms below this severity are not told.
    """

    def __init__(
        self, target: Target, table: NoticeTable, rig: str, clock: Clock, pace: Pace, least: Severity = "warning"
    ) -> None:
        self.target = target
        self._table, self._rig, self._clock, self._pace, self._least = table, rig, clock, pace, least
        self._real = SystemClock()  # networks and people wait in real time, whatever the rig's clock does
        now = clock.now()
        rows = table.waiting(target.name, now.utc_ns - STALE_NS, WAITING_MAX)
        self._waiting = [_Entry(_notice(row), row["id"]) for row in rows]
        # Alarms that were told, or wait to be, and are not over
        self._uncleared = {notice.key: notice for notice in map(_notice, table.uncleared(target.name))}
        self._unlisted = 0
        self._unwritten: list[tuple[Notice, Stamp]] = []  # sent before the store took them
        self._sent_through: tuple[int, Stamp] | None = None  # what the store is still to know
        self._retry_s = pace.first_retry_s
        self._due_ns = self._real.monotonic_ns() if self._waiting else None
        hour_ago_ns = now.utc_ns - round(HOUR_S * NS_PER_S)
        ages = (now.utc_ns - utc_ns for utc_ns in table.sent_since(target.name, hour_ago_ns))
        self._sent_ns = deque(self._real.monotonic_ns() - max(age, 0) for age in ages)
        self._sent = self._failures = 0
        self._error: str | None = None

    # ---- what is to be told ------------------------------------------------------------------------------------------

    def reconcile(self, alarms: Sequence[Mapping[str, Any]], now: Stamp) -> None:
        """Add what was never queued because the daemon was killed: alarms that stand, and alarms that are over.

        Args:
            alarms: those that are active by the store, as rows.
            now: this instant.
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
        """Take a notice, if this target is to be told of it."""
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
        self._waiting.append(_Entry(notice))
        if len(self._waiting) > WAITING_MAX:
            del self._waiting[0]
            self._unlisted += 1
        if self._due_ns is None:
            self._due_ns = self._real.monotonic_ns() + round(self._pace.gather_s * NS_PER_S)

    # ---- store and target --------------------------------------------------------------------------------------------

    @property
    def is_written(self) -> bool:
        """True if the store has all of it."""
        has_new = any(entry.row is None for entry in self._waiting)
        return not (has_new or self._unwritten or self._sent_through)

    def write(self) -> None:
        """Bring the store up to date; sqlite3.Error or StoreError where it cannot be written."""
        if self.is_written:
            return
        with self._table.transaction():
            rows = [
                self._table.add(self.target.name, **vars(entry.notice)) if entry.row is None else entry.row
                for entry in self._waiting
            ]
            for notice, sent in self._unwritten:
                self._table.add(self.target.name, sent=sent, **vars(notice))
            if self._sent_through is not None:
                self._table.mark_sent(self.target.name, *self._sent_through)
        for entry, row in zip(self._waiting, rows, strict=True):
            entry.row = row
        self._unwritten.clear()
        self._sent_through = None

    def due_in_s(self) -> float | None:
        """Seconds until the next delivery is to be tried; None where nothing waits."""
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
        """Deliver all that waits as one message; what fails is tried again later."""
        notices = [entry.notice for entry in self._waiting]
        try:
            self.target.deliver(message_of(self._rig, notices, self._unlisted))
        except Exception as error:  # a fault of one message or target must not end those of others
            self._failures += 1
            text = str(error) if isinstance(error, DeliveryError) else f"{type(error).__name__}: {error}"
            if text != self._error:
                is_defect = not isinstance(error, DeliveryError)
                log.warning(
                    "notices are not delivered by %s, and tried again: %s", self.target.name, text, exc_info=is_defect
                )
            self._error = text
            self._due_ns = self._real.monotonic_ns() + round(self._retry_s * NS_PER_S)
            self._retry_s = min(2 * self._retry_s, self._pace.longest_retry_s)
            return
        now = self._clock.now()
        log.info("%d notices are delivered by %s", len(notices) + self._unlisted, self.target.name)
        self._unwritten += [(entry.notice, now) for entry in self._waiting if entry.row is None]
        written = [entry.row for entry in self._waiting if entry.row is not None]
        if written:
            self._sent_through = max(written), now
        self._waiting.clear()
        self._unlisted = 0
        self._due_ns, self._error = None, None
        self._retry_s = self._pace.first_retry_s
        self._sent_ns.append(self._real.monotonic_ns())
        self._sent += 1

    def status(self) -> dict[str, Any]:
        """Return messages sent and failed since the start, notices that wait, and the last error."""
        return {
            "target": self.target.name,
            "waiting": len(self._waiting) + self._unlisted,
            "sent": self._sent,
            "failures": self._failures,
            "error": self._error,
        }


def _notice(row: Mapping[str, Any]) -> Notice:
    return Notice(**{field.name: row[field.name] for field in fields(Notice)})
