"""The tables of station set-ups: where a total station stands, its control points, and their shots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from daemon.store.connection import Connection
from daemon.store.rows import RowSource, marks
from drivers.clock import Stamp
from drivers.readings import EventKind

_OF_SESSIONS = """SELECT id, instrument, state FROM station_setups
    WHERE id IN (SELECT setup_id FROM calibration_sessions WHERE id IN ({})) ORDER BY rowid"""
_MISCLOSURES = """SELECT s.name, s.phase, s.x_mm - p.x_mm AS x, s.y_mm - p.y_mm AS y, s.z_mm - p.z_mm AS z
    FROM control_shots AS s JOIN control_points AS p ON p.setup_id = s.setup_id AND p.name = s.name
    WHERE s.setup_id = ? AND s.session_id IN ({}) ORDER BY s.id"""
# A set-up is named by its description, a guide or a session. An open guide or session takes precedence over later ones.
# Closed sessions of any rig count, because the station stays where it stands when the rig gets another name.
_CURRENT = """WITH named AS (
        SELECT * FROM (SELECT id AS setup_id, 0 AS is_open, created_boot_id AS boot, created_monotonic_ns AS at
            FROM station_setups ORDER BY rowid DESC LIMIT 1)
        UNION ALL SELECT * FROM (SELECT setup_id, state = 'open', started_boot_id, started_monotonic_ns
            FROM guides WHERE rig = ?1 ORDER BY id DESC LIMIT 1)
        UNION ALL SELECT * FROM (SELECT setup_id, state = 'open' AND rig = ?1, started_boot_id, started_monotonic_ns
            FROM calibration_sessions ORDER BY rowid DESC LIMIT 1))
    SELECT id, state FROM named JOIN station_setups ON id = setup_id
    ORDER BY is_open DESC, boot DESC, at DESC LIMIT 1"""
# The newest shot of each control point of a set-up: with max(), SQLite takes the other columns from its row.
_NEWEST_SHOTS = """SELECT max(id) AS id, setup_id AS setup, name AS point, session_id AS session, phase, utc_ns,
        misclosure_mm FROM control_shots WHERE setup_id = ? GROUP BY name ORDER BY name"""
# An aborted session is unusable, and so are the places that it alone gave to control points.
_POINTS = """SELECT name, x_mm, y_mm, z_mm FROM control_points AS p WHERE setup_id = ?1 AND (
        NOT EXISTS (SELECT 1 FROM control_shots AS s
            WHERE s.setup_id = ?1 AND s.name = p.name AND s.misclosure_mm IS NULL)
        OR EXISTS (SELECT 1 FROM control_shots AS s JOIN calibration_sessions AS c ON c.id = s.session_id
            WHERE s.setup_id = ?1 AND s.name = p.name AND (c.state != 'aborted' OR c.id = ?2)))
    ORDER BY p.rowid"""
# The number of the boot increases from boot to boot, and monotonic_ns within a boot; utc_ns may step.
_SHOT_EVENTS = """SELECT kind, utc_ns, monotonic_ns, boot_id FROM device_events
    WHERE device = ? AND kind IN ('shot_begun', 'shot_ended') AND (boot_id, monotonic_ns) >= (?, ?)
    ORDER BY boot_id, monotonic_ns, id"""
_POINT_SHOTS = """SELECT s.session_id, s.phase, s.misclosure_mm FROM control_shots AS s
    JOIN calibration_sessions AS c ON c.id = s.session_id
    WHERE s.setup_id = ? AND s.name = ? AND c.state != 'aborted'"""


@dataclass(frozen=True)
class SetupRow:
    """A station set-up.

    Attributes:
        id: name of the set-up.
        state: ok, moved or closed.
    """

    id: str
    state: str


class SetupTable:
    """The station set-ups of a store.

    Args:
        store: the database.
        rig_name: name of the rig, whose sessions and guides show where the station stands.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name

    def all(self) -> list[dict[str, Any]]:
        """Return all set-ups with their control points, oldest first."""
        setups = self._store.rows(
            "SELECT id, instrument, serial, tilt_arcsec, ppm, state, note FROM station_setups ORDER BY rowid"
        )
        return [setup | {"control_points": control_points(self._store, setup["id"])} for setup in setups]

    def states(self) -> dict[str, str]:
        """Return the state of each set-up, oldest first."""
        rows = self._store.rows("SELECT id, state FROM station_setups ORDER BY rowid")
        return {row["id"]: row["state"] for row in rows}

    def constants_mm(self, setup_id: str) -> dict[str, float]:
        """Return prism -> constant, mm, from a set-up's description."""
        rows = self._store.rows("SELECT prism_constants_json FROM station_setups WHERE id = ?", (setup_id,))
        return {prism: mm for row in rows for prism, mm in json.loads(row["prism_constants_json"]).items()}

    def current(self) -> SetupRow | None:
        """Return the set-up that the station stands in; None before the first.

        This is the set-up of the open session or guide, or else the one last described or used for a session or guide.
        """
        found = self._store.rows(_CURRENT, (self._rig,))
        return SetupRow(**found[0]) if found else None

    def point_shots(self, setup_id: str, name: str) -> list[dict[str, Any]]:
        """Return session, phase and misclosure_mm of a control point's shots in sessions that were not aborted."""
        return self._store.rows(_POINT_SHOTS, (setup_id, name))

    def current_shots(self) -> list[dict[str, Any]]:
        """Return the newest shot of each control point of the current set-up."""
        current = self.current()
        return [] if current is None else self._store.rows(_NEWEST_SHOTS, (current.id,))

    def add(self, created: Stamp, **columns: object) -> None:
        """Add a set-up."""
        self._store.insert("station_setups", {**columns, "state": "ok", **self._store.instant(created, "created_")})

    def put_control_point(self, setup_id: str, name: str, place: Mapping[str, float]) -> None:
        """Add a control point, or change its place: `x_mm`, `y_mm` and `z_mm`."""
        key = {"setup_id": setup_id, "name": name}
        if not self._store.update("control_points", key, place):
            self._store.insert("control_points", {**key, **place})

    def add_shot(self, setup_id: str, name: str, measured: Stamp, **columns: object) -> None:
        """Add a shot of a control point."""
        through = self._store.number("SELECT coalesce(max(id), 0) FROM observations", ())
        row = {"setup_id": setup_id, "name": name, "observations_through": through, **columns}
        row |= self._store.instant(measured)
        self._store.insert("control_shots", row)

    def mark_moved(self, setup_id: str) -> None:
        """Mark a set-up as moved: a control point is not where it was."""
        self._store.update("station_setups", {"id": setup_id}, {"state": "moved"})


def shot_events(store: Connection, station: str, since: Stamp) -> list[tuple[EventKind, Stamp]]:
    """Return when a station's shots of control points have begun and ended from an instant on, in order."""
    rows = store.rows(_SHOT_EVENTS, (station, *store.order(since)))
    return [(EventKind(row["kind"]), store.stamp(row)) for row in rows]


# ---- for the writing connection and for readers ----------------------------------------------------------------------


def control_points(source: RowSource, setup_id: str, session_id: str = "") -> list[dict[str, Any]]:
    """Return name, x_mm, y_mm and z_mm of a set-up's control points, in the order of definition.

    Points that were located only in sessions that were aborted are left out.

    Args:
        source: the store.
        setup_id: the set-up.
        session_id: points that were located in this session are included, even if it was aborted.
    """
    return list(source.rows(_POINTS, (setup_id, session_id)))


def setups_of(source: RowSource, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return id, instrument and state of the set-ups of sessions, oldest first."""
    return list(source.rows(_OF_SESSIONS.format(marks(session_ids)), session_ids))


def misclosures(source: RowSource, setup_id: str, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return the shots of a set-up's control points in some sessions, oldest first.

    Returns:
        name, phase, and x, y, z: offset from the point's known place, mm in the station's frame.
    """
    return list(source.rows(_MISCLOSURES.format(marks(session_ids)), (setup_id, *session_ids)))
