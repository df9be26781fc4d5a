"""The store's table of alarms: those that are active and those that were."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from daemon.store.store import Store
from drivers.clock import Stamp

_COLUMNS = "id, kind, subject, severity, text, remedy"


@dataclass(frozen=True)
class AlarmRow:
    """An active alarm, as the store has it.

    Attributes:
        id: its number.
        kind, subject, severity, text, remedy: see daemon.alarms.alarm.
        raised: when it was noticed.
    """

    id: int
    kind: str
    subject: str
    severity: str
    text: str
    remedy: str
    raised: Stamp


class AlarmTable:
    """The alarms of a store.

    Args:
        store: where they are.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def active(self) -> list[AlarmRow]:
        """Those that are not cleared, oldest first."""
        rows = self._store.rows(
            f"SELECT {_COLUMNS}, raised_utc_ns, raised_monotonic_ns, raised_boot_id FROM alarms "
            "WHERE cleared_utc_ns IS NULL ORDER BY id"
        )
        found = []
        for row in rows:
            raised = self._store.stamp(row, "raised_")
            assert raised is not None  # the columns are NOT NULL
            found.append(AlarmRow(raised=raised, **{name: row[name] for name in _COLUMNS.split(", ")}))
        return found

    def add(self, raised: Stamp, kind: str, subject: str, **about: str) -> int:
        """A new alarm, in the place of one of that kind and subject that is still active; its number."""
        key: dict[str, object] = {"kind": kind, "subject": subject}
        with self._store.transaction():
            self._store.update("alarms", {**key, "cleared_utc_ns": None}, self._store.instant(raised, "cleared_"))
            return self._store.insert("alarms", {**key, **about, **self._store.instant(raised, "raised_")})

    def change(self, alarm_id: int, **about: str) -> None:
        """Severity, text or remedy of an active alarm have changed."""
        self._store.update("alarms", {"id": alarm_id}, about)

    def clear(self, alarm_id: int, cleared: Stamp) -> None:
        """An alarm is over."""
        self._store.update("alarms", {"id": alarm_id}, self._store.instant(cleared, "cleared_"))

    def cleared(self, most: int) -> list[dict[str, Any]]:
        """Those that were cleared, newest first."""
        return self._store.rows(
            "SELECT kind, subject, severity, text, remedy, raised_utc_ns AS since_utc_ns, cleared_utc_ns FROM alarms "
            "WHERE cleared_utc_ns IS NOT NULL ORDER BY id DESC LIMIT ?",
            (most,),
        )
