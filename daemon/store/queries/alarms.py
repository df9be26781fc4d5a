"""The table of alarms, active and cleared."""

from __future__ import annotations

from typing import Any

from daemon.store.connection import Connection
from drivers.clock import Stamp

_ACTIVE = """SELECT id, kind, subject, severity, text, remedy, raised_utc_ns, raised_monotonic_ns, raised_boot_id
    FROM alarms WHERE cleared_utc_ns IS NULL ORDER BY id"""


class AlarmTable:
    """The alarms of a store.

    Args:
        store: the database.
    """

    def __init__(self, store: Connection) -> None:
        self._store = store

    def active(self) -> list[dict[str, Any]]:
        """Return the active alarms, oldest first, with the instant `raised`; none if the table is damaged."""
        rows: list[dict[str, Any]] = self._store.unless_damaged(lambda: self._store.rows(_ACTIVE), [])
        return [row | {"raised": self._store.stamp(row, "raised_")} for row in rows]

    def add(self, raised: Stamp, kind: str, subject: str, **about: str) -> int:
        """Add an alarm, clear any active alarm of the same kind and subject, and return the new alarm's number."""
        key: dict[str, object] = {"kind": kind, "subject": subject}
        with self._store.transaction():
            self._store.update("alarms", {**key, "cleared_utc_ns": None}, self._store.instant(raised, "cleared_"))
            return self._store.insert("alarms", {**key, **about, **self._store.instant(raised, "raised_")})

    def change(self, alarm_id: int, **about: str) -> None:
        """Change severity, text or remedy of an active alarm."""
        self._store.update("alarms", {"id": alarm_id}, about)

    def clear(self, alarm_id: int, cleared: Stamp) -> None:
        """Mark an alarm as cleared."""
        self._store.update("alarms", {"id": alarm_id}, self._store.instant(cleared, "cleared_"))

    def cleared(self, most: int) -> list[dict[str, Any]]:
        """Return the cleared alarms, newest first, at most `most`."""
        return self._store.rows(
            "SELECT kind, subject, severity, text, remedy, raised_utc_ns AS since_utc_ns, cleared_utc_ns FROM alarms "
            "WHERE cleared_utc_ns IS NOT NULL ORDER BY id DESC LIMIT ?",
            (most,),
        )
