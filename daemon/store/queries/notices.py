"""The table of notices: the sent and the pending notices of each target."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from sqlite_utils import Database

from daemon.store.connection import Connection
from drivers.clock import Stamp

_COLUMNS = """id, event, kind, subject, severity, text, remedy, utc_ns, monotonic_ns, boot_id,
    raised_utc_ns, raised_monotonic_ns, raised_boot_id"""
_WAITING = f"""SELECT {_COLUMNS} FROM notices WHERE target = ? AND sent_utc_ns IS NULL AND utc_ns >= ?
    ORDER BY id DESC LIMIT ?"""
_UNCLEARED = f"""SELECT {_COLUMNS} FROM notices WHERE event = 'raised' AND id IN
    (SELECT max(id) FROM notices WHERE target = ? AND event != 'test' GROUP BY kind, subject)"""
_MARK = """UPDATE notices SET sent_utc_ns = ?, sent_monotonic_ns = ?, sent_boot_id = ?
    WHERE target = ? AND sent_utc_ns IS NULL AND id <= ?"""


class NoticeTable:
    """The notices of a store, as rows with the columns of `daemon.monitoring.notice.Notice`, and `at` and `raised`.

    Args:
        store: the database.
    """

    def __init__(self, store: Connection) -> None:
        self._store = store

    def transaction(self) -> AbstractContextManager[Database]:
        """Return a transaction for several changes."""
        return self._store.transaction()

    def add(self, target: str, at: Stamp, raised: Stamp, sent: Stamp | None = None, **about: str) -> int:
        """Add a notice for a target, and return its number.

        Args:
            target: the target.
            at: instant of the event.
            raised: when the alarm was raised.
            sent: when the notice was sent; None if it is pending.
            about: further columns.
        """
        row = {"target": target, **about, **self._store.instant(at), **self._store.instant(raised, "raised_")}
        if sent is not None:
            row |= self._store.instant(sent, "sent_")
        return self._store.insert("notices", row)

    def mark_sent(self, target: str, through: int, sent: Stamp) -> None:
        """Mark all pending notices of a target, up to number `through`, as sent."""
        with self._store.transaction() as db:
            db.execute(_MARK, [*self._store.instant(sent).values(), target, through])

    def waiting(self, target: str, since_utc_ns: int, most: int) -> list[dict[str, Any]]:
        """Return the newest pending notices of a target, oldest first; none if the table is damaged."""
        found = self._rows(_WAITING, target, since_utc_ns, most)
        return [*reversed(found)]

    def uncleared(self, target: str) -> list[dict[str, Any]]:
        """Return the newest notice of each alarm for which a target has received no clearing notice."""
        return self._rows(_UNCLEARED, target)

    def sent_since(self, target: str, since_utc_ns: int) -> list[int]:
        """Return when notices were sent to a target, UTC ns, oldest first."""
        sql = "SELECT DISTINCT sent_utc_ns FROM notices WHERE target = ? AND sent_utc_ns >= ? ORDER BY sent_utc_ns"
        rows: list[dict[str, Any]] = self._store.unless_damaged(
            lambda: self._store.rows(sql, (target, since_utc_ns)), []
        )
        return [int(row["sent_utc_ns"]) for row in rows]

    def _rows(self, sql: str, *parameters: object) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self._store.unless_damaged(lambda: self._store.rows(sql, parameters), [])
        return [self._with_stamps(row) for row in rows]

    def _with_stamps(self, row: Mapping[str, Any]) -> dict[str, Any]:
        return {**row, "at": self._store.stamp(row), "raised": self._store.stamp(row, "raised_")}
