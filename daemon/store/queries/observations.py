"""The table of observations: fixes of a session's prism with the joints at their instants."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from daemon.store.connection import Connection
from daemon.store.places import since
from daemon.store.rows import RowSource, marks
from drivers.clock import Stamp

OF_CONTROL_POINT = "a control point, not the prism"  # why an observation must not be used

# A control point is not a prism of the rig, so this reason is never replaced by later findings about prisms.
_EXCLUDE = f"""UPDATE observations SET excluded = ? WHERE session_id = ? AND boot_id = ? AND monotonic_ns = ?
    AND excluded IS NOT '{OF_CONTROL_POINT}'"""
_EXCLUDE_NEAR = f"""UPDATE observations SET excluded = '{OF_CONTROL_POINT}' WHERE session_id = ?1 AND excluded IS NULL
    AND (x_mm - ?2) * (x_mm - ?2) + (y_mm - ?3) * (y_mm - ?3) + (z_mm - ?4) * (z_mm - ?4) < ?5 * ?5"""
_OBSERVATIONS = """SELECT session_id, setup_id, prism, pose, utc_ns, monotonic_ns, boot_id, x_mm, y_mm, z_mm,
        sigma_x_mm, sigma_y_mm, sigma_z_mm, dwell_s, values_json
    FROM observations WHERE excluded IS NULL AND session_id IN ({}) ORDER BY id"""
# Fixes of a moving boom, which have no other reason for their exclusion.
_MOVING = _OBSERVATIONS.replace("excluded IS NULL", "moving AND coalesce(excluded, 'moving') = 'moving'")
_FIRST = """SELECT utc_ns, monotonic_ns, kernel_boot_id FROM observations JOIN boots ON boots.id = boot_id
    WHERE excluded IS NULL ORDER BY observations.id LIMIT 1"""
# A station's fixes in a session from the last one that calibration may use, or from the session's start.
_FIXES = f"""SELECT fixes.* FROM calibration_sessions AS session CROSS JOIN boots CROSS JOIN fixes
    WHERE session.id = ?1 AND station = ?2
        AND {since("fixes.", ("session.started_boot_id", "session.started_monotonic_ns"))}
        AND fixes.id >= coalesce((SELECT max(fix_id) FROM observations JOIN fixes AS used ON used.id = fix_id
            WHERE session_id = ?1 AND excluded IS NULL AND used.station = ?2), 0)
    ORDER BY fixes.id"""

# Each station's oldest fix that is of the prism, as far as is known, and contains a prism constant.
_FIRST_CONSTANTS = """SELECT fixes.station, fixes.prism_constant_mm, min(observations.id) AS oldest
    FROM observations JOIN fixes ON fixes.id = fix_id
    WHERE session_id = ? AND prism_constant_mm IS NOT NULL AND excluded IS NULL GROUP BY station"""


class ObservationTable:
    """The observations of a store.

    Args:
        store: the database.
    """

    def __init__(self, store: Connection) -> None:
        self._store = store

    def add(self, fix_id: int | None, measured: Stamp, **columns: object) -> None:
        """Add the observation of a fix."""
        self._store.insert("observations", {**columns, "fix_id": fix_id, **self._store.instant(measured)})

    def exclude(self, session_id: str, exclusions: Mapping[int, str | None], newest: Stamp) -> None:
        """Change why observations of a session must not be used.

        Args:
            session_id: the session.
            exclusions: instant of a fix, monotonic ns -> why calibration must not use it; None if it may.
            newest: instant of the newest fix; all fixes are of its boot.
        """
        with self._store.transaction() as db:
            boot = self._store.boot_row(newest)
            rows = [(excluded, session_id, boot, at_ns) for at_ns, excluded in exclusions.items()]
            db.conn.executemany(_EXCLUDE, rows)

    def exclude_near(self, session_id: str, point_mm: Sequence[float], radius_mm: float) -> None:
        """Exclude the observations of a session that lie near a control point and are not excluded yet."""
        with self._store.transaction() as db:
            db.conn.execute(_EXCLUDE_NEAR, (session_id, *point_mm, radius_mm))


# ---- for the writing connection and for readers ----------------------------------------------------------------------


def observations(source: RowSource, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return the observations of sessions that calibration may use, oldest first."""
    return list(source.rows(_OBSERVATIONS.format(marks(session_ids)), session_ids))


def moving_observations(source: RowSource, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return the observations of sessions that were measured while the boom moved and have no other fault."""
    return list(source.rows(_MOVING.format(marks(session_ids)), session_ids))


def all_observations(source: RowSource, session_ids: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return used and excluded observations of some or all sessions, oldest first; joints and signals as columns.

    Args:
        source: the store.
        session_ids: the sessions; empty for all.
    """
    where = f"WHERE session_id IN ({marks(session_ids)})" if session_ids else ""
    rows = source.rows(
        "SELECT session_id, setup_id, prism, pose, utc_ns, x_mm, y_mm, z_mm, sigma_x_mm, sigma_y_mm, sigma_z_mm, "
        f"dwell_s, excluded, values_json FROM observations {where} ORDER BY id",
        session_ids,
    )
    return [{**row, **json.loads(row.pop("values_json"))} for row in rows]


def first_observation(source: RowSource) -> dict[str, Any] | None:
    """Return utc_ns, monotonic_ns and kernel_boot_id of the first observation that calibration may use, or None."""
    return next(iter(source.rows(_FIRST)), None)


def first_constants_mm(source: RowSource, session_id: str) -> dict[str, float]:
    """Return the prism constants that stations applied to their first used fixes in a session.

    Returns:
        Station -> constant, mm.
    """
    rows = source.rows(_FIRST_CONSTANTS, (session_id,))
    return {row["station"]: row["prism_constant_mm"] for row in rows}


def fixes_since_used(source: RowSource, session_id: str, station: str) -> Iterator[dict[str, Any]]:
    """Return a station's fixes in a session, from the last one that calibration may use, or from its start."""
    return iter(source.rows(_FIXES, (session_id, station)))
