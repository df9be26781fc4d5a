"""The tables of guided sessions: guides and their events."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from daemon.commands import Caller
from daemon.store.connection import Connection
from daemon.store.reader import Reader
from drivers.clock import Stamp

# The newest standstill with used observations. Runs ten times a second, so it searches by number, not all rows.
_STANDSTILL = """SELECT pose, count(*) AS fixes, max(id) AS last FROM observations NOT INDEXED
    WHERE session_id = ? AND id > ? AND excluded IS NULL AND pose IS NOT NULL
    GROUP BY pose ORDER BY last DESC LIMIT 1"""
_REQUEST = """SELECT guides.id, request_json FROM guide_events JOIN guides ON guides.id = guide_id
    WHERE kind = 'opened' AND json_extract(details_json, '$.session') = ?"""


@dataclass(frozen=True)
class GuideRow:
    """A guide.

    Attributes:
        id: number of the guide.
        state: open, finished or abandoned.
        setup_id: set-up of its station.
        operator: operator who is responsible.
        caller: process that started it; None if its table is from before this was stored.
        request: its request.
        taps: number of commands given to it.
        started: when it was started.
    """

    id: int
    state: str
    setup_id: str
    operator: str
    caller: Caller | None
    request: Mapping[str, Any]
    taps: int
    started: Stamp


@dataclass(frozen=True)
class EventRow:
    """An event of a guide.

    Attributes:
        kind, details: see `daemon.guide.job`.
        at: instant of the event.
    """

    kind: str
    details: Mapping[str, Any]
    at: Stamp


@dataclass(frozen=True)
class Standstill:
    """A standstill of the open session with used observations.

    Attributes:
        pose: label of the standstill.
        fixes: number of used fixes.
        last: number of the newest observation.
        values: observations column -> number, of the newest observation.
    """

    pose: str
    fixes: int
    last: int
    values: Mapping[str, float]


class GuideTable:
    """The guides of a rig.

    Args:
        store: the database.
        rig_name: name of the rig.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name

    def newest(self) -> GuideRow | None:
        """Return the newest guide; None before the first."""
        rows = self._store.rows("SELECT * FROM guides WHERE rig = ? ORDER BY id DESC LIMIT 1", (self._rig,))
        if not rows:
            return None
        row = rows[0]
        caller = None if row["caller_uid"] is None else Caller(row["caller_user"], row["caller_uid"], row["caller_pid"])
        return GuideRow(
            row["id"],
            row["state"],
            row["setup_id"],
            row["operator"],
            caller,
            json.loads(row["request_json"]),
            row["taps"],
            self._store.stamp(row, "started_"),
        )

    def is_open(self) -> bool:
        """Return True if a guide is open."""
        return bool(self._store.rows("SELECT 1 FROM guides WHERE rig = ? AND state = 'open'", (self._rig,)))

    def open(self, started: Stamp, setup_id: str, operator: str, request: Mapping[str, Any], **caller: object) -> int:
        """Add an open guide, and return its number."""
        row = {
            "rig": self._rig,
            "state": "open",
            "setup_id": setup_id,
            "operator": operator,
            "request_json": request,
            "taps": 1,
        }
        return self._store.insert("guides", {**row, **caller, **self._store.instant(started, "started_")})

    def count_taps(self, guide_id: int, taps: int) -> None:
        """Set the number of commands given to a guide."""
        self._store.update("guides", {"id": guide_id}, {"taps": taps})

    def end(self, guide_id: int, state: str, ended: Stamp) -> None:
        """Mark a guide as finished or abandoned."""
        self._store.update("guides", {"id": guide_id}, {"state": state, **self._store.instant(ended, "ended_")})

    def add(self, guide_id: int, kind: str, details: Mapping[str, Any], at: Stamp, **caller: object) -> None:
        """Add an event."""
        row = {"guide_id": guide_id, "kind": kind, "details_json": details, **caller}
        self._store.insert("guide_events", {**row, **self._store.instant(at)})

    def events(self, guide_id: int) -> list[EventRow]:
        """Return all events of a guide, oldest first."""
        return guide_events(self._store, guide_id)

    def newest_observation(self) -> int:
        """Return the number of the store's newest observation; 0 before the first."""
        return self._store.number("SELECT coalesce(max(id), 0) FROM observations", ()) or 0

    def standstill(self, session_id: str, after: int) -> Standstill | None:
        """Return a session's newest standstill with used observations newer than number `after`, or None."""
        rows = self._store.rows(_STANDSTILL, (session_id, after))
        if not rows:
            return None
        (values,) = self._store.rows("SELECT values_json FROM observations WHERE id = ?", (rows[0]["last"],))
        return Standstill(**rows[0], values=json.loads(values["values_json"]))


# ---- for the writing connection and for readers ----------------------------------------------------------------------


def guide_events(source: Connection | Reader, guide_id: int) -> list[EventRow]:
    """Return all events of a guide, oldest first."""
    rows = source.rows("SELECT * FROM guide_events WHERE guide_id = ? ORDER BY id", (guide_id,))
    return [EventRow(row["kind"], json.loads(row["details_json"]), source.stamp(row)) for row in rows]


def guide_request(source: Connection | Reader, session_id: str) -> tuple[int, Mapping[str, Any]] | None:
    """Return number and request of the guide that held a session; None if it was not guided."""
    rows = source.rows(_REQUEST, (session_id,))
    return next(((row["id"], json.loads(row["request_json"])) for row in rows), None)
