"""The table of observations: fixes of a session's prism with the joints at their instants."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from daemon.store.connection import Connection
from daemon.store.places import since
from daemon.store.rows import RowSource, marks
from drivers.clock import Stamp

OBSERVATION_COLUMNS = (
    *("session_id", "setup_id", "prism", "pose", "utc_ns", "x_mm", "y_mm", "z_mm"),
    *("sigma_x_mm", "sigma_y_mm", "sigma_z_mm", "dwell_s", "excluded"),
)
OF_CONTROL_POINT = "a control point, not the prism"  # why an observation must not be used

# A control point is not a prism of the rig, so this reason is never replaced by later findings about prisms.
_EXCLUDE = f"""UPDATE observations SET excluded = coalesce(?, CASE WHEN moving THEN ? END)
    WHERE session_id = ? AND boot_id = ? AND monotonic_ns = ?
    AND excluded IS NOT '{OF_CONTROL_POINT}'"""
# Session, place and radius in mm
_NEAR = """session_id = ?1
    AND (x_mm - ?2) * (x_mm - ?2) + (y_mm - ?3) * (y_mm - ?3) + (z_mm - ?4) * (z_mm - ?4) < ?5 * ?5"""
_EXCLUDE_NEAR = f"UPDATE observations SET excluded = '{OF_CONTROL_POINT}' WHERE excluded IS NULL AND {_NEAR}"
# Undoes _EXCLUDE_NEAR for a place that was not the point's. It changed only observations that were stored before the
# point's first shot in the session: a shot after which observations were used is not one that locates the point.
_INCLUDE_NEAR = f"""UPDATE observations SET excluded = NULL WHERE excluded = '{OF_CONTROL_POINT}' AND {_NEAR}
    AND id <= (SELECT observations_through FROM control_shots
        WHERE session_id = ?1 AND name = ?6 ORDER BY id LIMIT 1)"""
_OBSERVATIONS = """SELECT session_id, setup_id, prism, pose, utc_ns, monotonic_ns, boot_id, x_mm, y_mm, z_mm,
        sigma_x_mm, sigma_y_mm, sigma_z_mm, dwell_s, values_json
    FROM observations WHERE excluded IS NULL AND session_id IN ({}) ORDER BY id"""
# Fixes of a moving boom, which have no other reason for their exclusion.
_MOVING = _OBSERVATIONS.replace("excluded IS NULL", "moving AND coalesce(excluded, 'moving') = 'moving'")
_FIRST = """SELECT utc_ns, monotonic_ns, kernel_boot_id FROM observations JOIN boots ON boots.id = boot_id
    WHERE excluded IS NULL ORDER BY observations.id LIMIT 1"""
# A station's fixes in a session from the last one that calibration may use, or from the session's start.
_FIXES = f"""SELECT fixes.*, seen.excluded FROM calibration_sessions AS session CROSS JOIN boots CROSS JOIN fixes
        LEFT JOIN observations AS seen ON seen.fix_id = fixes.id AND seen.session_id = session.id
    WHERE session.id = ?1 AND station = ?2
        AND {since("fixes.", ("session.started_boot_id", "session.started_monotonic_ns"))}
        AND fixes.id >= coalesce((SELECT fix_id FROM observations AS o CROSS JOIN fixes AS used ON used.id = fix_id
            WHERE session_id = ?1 AND excluded IS NULL AND used.station = ?2
            ORDER BY o.boot_id DESC, o.monotonic_ns DESC LIMIT 1), 0)
    ORDER BY fixes.id"""
# Observations of the last standstill of each run of the daemon; poses are called `run.standstill`.
_LAST_STANDSTILLS = """SELECT pose, utc_ns, monotonic_ns, boot_id, x_mm, y_mm, z_mm, values_json, excluded
    FROM observations
    WHERE session_id = ?1 AND (excluded IS NULL OR excluded LIKE ?2) AND pose IN (
        SELECT pose FROM (SELECT pose, max(id) FROM observations WHERE session_id = ?1 AND pose IS NOT NULL
            GROUP BY substr(pose, 1, instr(pose, '.'))))
    ORDER BY id LIMIT ?3"""
# A session's newest observation, which lies at the end of the table while the session is open.
_NEWEST = """SELECT utc_ns, monotonic_ns, boot_id, excluded FROM observations NOT INDEXED WHERE session_id = ?
    ORDER BY id DESC LIMIT 1"""

# Each station's oldest fix that is of the prism, as far as is known, and contains a prism constant. A station that
# transmits constants does so from its first fix on, so the rest of a long session is not read.
_FIRST_CONSTANTS = """SELECT fixes.station, fixes.prism_constant_mm, min(first.id) AS oldest
    FROM (SELECT id, fix_id FROM observations WHERE session_id = ? AND excluded IS NULL
        ORDER BY boot_id, monotonic_ns LIMIT 10000) AS first CROSS JOIN fixes ON fixes.id = first.fix_id
    WHERE prism_constant_mm IS NOT NULL GROUP BY station"""
# The stations of a session's observations
_STATIONS = """SELECT DISTINCT fixes.station FROM observations CROSS JOIN fixes ON fixes.id = fix_id
    WHERE session_id = ? ORDER BY fixes.station"""
# A session's observations: all of them by the index, or with NOT INDEXED the newest by their numbers.
TOTALS = """SELECT max(id) AS last, count(*) FILTER (WHERE excluded IS NULL) AS used, min(boot_id) AS first_boot,
        max(boot_id) AS last_boot, min(utc_ns - monotonic_ns) AS least_ns, max(utc_ns - monotonic_ns) AS most_ns
    FROM observations {} WHERE session_id = ? AND id > ?"""
POSES = """SELECT DISTINCT pose FROM observations {} WHERE session_id = ? AND id > ? AND id <= ?
        AND excluded IS NULL AND pose IS NOT NULL"""
EXCLUDED = """SELECT excluded AS reason, count(*) AS n FROM observations {} WHERE session_id = ? AND id > ? AND id <= ?
        AND excluded IS NOT NULL GROUP BY excluded"""


Clock = tuple[int, int, int, int]
"""First and last boot of some instants; the least and the largest difference of UTC and monotonic time, ns."""


@dataclass(frozen=True)
class Tally:
    """Counts of a session's observations.

    Attributes:
        session_id: the session.
        through: number of the newest observation that is counted.
        used: number of observations that calibration may use.
        poses: their poses.
        excluded: reason -> number of observations that calibration must not use.
        clock: the clocks at all observations; None without any.
        steps: steps of the computer's clock, by what the clocks showed; filled by the summary of the session.
    """

    session_id: str
    through: int = 0
    used: int = 0
    poses: frozenset[str] = frozenset()
    excluded: Mapping[str, int] = field(default_factory=dict)
    clock: Clock | None = None
    steps: dict[object, list[dict[str, Any]]] = field(default_factory=dict)

    def clock_with(self, other: Sequence[int]) -> Clock:
        """Return the clocks at all observations and at other instants."""
        clock = self.clock or other
        return min(clock[0], other[0]), max(clock[1], other[1]), min(clock[2], other[2]), max(clock[3], other[3])


def tally_of(source: RowSource, session_id: str, before: Tally | None = None) -> Tally:
    """Count the observations of a session.

    Args:
        source: the store.
        session_id: the session.
        before: an earlier tally of the session; only observations stored since are read.
    """
    tally = before or Tally(session_id)
    how = "NOT INDEXED" if tally.through else ""
    (found,) = source.rows(TOTALS.format(how), (session_id, tally.through))
    last, used, *clock = found.values()
    if last is None:
        return tally
    added = session_id, tally.through, last
    excluded = Counter({row["reason"]: row["n"] for row in source.rows(EXCLUDED.format(how), added)})
    return replace(
        tally,
        through=last,
        used=tally.used + used,
        poses=tally.poses.union(row["pose"] for row in source.rows(POSES.format(how), added)),
        excluded=Counter(tally.excluded) + excluded,
        clock=tally.clock_with(clock),
    )


class ObservationTable:
    """The observations of a store.

    Args:
        store: the database.
    """

    def __init__(self, store: Connection) -> None:
        self._store = store
        self._counting = threading.Lock()
        self._changes = 0  # number of changes of stored exclusions; a tally from before such a change is not extended
        self._tally: tuple[int, Tally] | None = None

    def tally(self, source: RowSource, session_id: str) -> Tally:
        """Count the observations of the newest session; those counted by an earlier call are not read again.

        Exclusions of stored observations must be changed through this table.

        Args:
            source: the store.
            session_id: the session that is open or has just ended.
        """
        with self._counting:
            changes, known = self._changes, self._tally
            is_known = known is not None and known[0] == changes and known[1].session_id == session_id
            tally = tally_of(source, session_id, known[1] if known is not None and is_known else None)
            self._tally = changes, tally
        return tally

    def _has_excluded(self) -> None:
        self._changes += 1

    def add(self, fix_id: int | None, measured: Stamp, **columns: object) -> None:
        """Add the observation of a fix."""
        self._store.insert("observations", {**columns, "fix_id": fix_id, **self._store.instant(measured)})

    def exclude(
        self, session_id: str, exclusions: Mapping[int, str | None], newest: Stamp, *, if_moving: str | None = None
    ) -> None:
        """Change why observations of a session must not be used.

        Args:
            session_id: the session.
            exclusions: instant of a fix, monotonic ns -> why calibration must not use it; None if it may.
            newest: instant of the newest fix; all fixes are of its boot.
            if_moving: why it must not use a fix of a moving boom that has no other fault; None if it may.
        """
        with self._store.transaction() as db:
            boot = self._store.boot_row(newest)
            rows = [(excluded, if_moving, session_id, boot, at_ns) for at_ns, excluded in exclusions.items()]
            db.conn.executemany(_EXCLUDE, rows)
            self._store.once_committed(self._has_excluded)

    def exclude_near(self, session_id: str, point_mm: Sequence[float], radius_mm: float) -> None:
        """Exclude the observations of a session that lie near a control point and are not excluded yet."""
        with self._store.transaction() as db:
            db.conn.execute(_EXCLUDE_NEAR, (session_id, *point_mm, radius_mm))
            self._store.once_committed(self._has_excluded)

    def include_near(self, session_id: str, point: str, place_mm: Sequence[float], radius_mm: float) -> None:
        """Undo `exclude_near` for a place that was wrongly taken for that of a control point."""
        with self._store.transaction() as db:
            db.conn.execute(_INCLUDE_NEAR, (session_id, *place_mm, radius_mm, point))
            self._store.once_committed(self._has_excluded)


# ---- for the writing connection and for readers ----------------------------------------------------------------------


def observations(source: RowSource, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return the observations of sessions that calibration may use, oldest first."""
    return list(source.rows(_OBSERVATIONS.format(marks(session_ids)), session_ids))


def moving_observations(source: RowSource, session_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return the observations of sessions that were measured while the boom moved and have no other fault."""
    return list(source.rows(_MOVING.format(marks(session_ids)), session_ids))


def stations_of(source: RowSource, session_id: str) -> list[str]:
    """Return the names of the stations that measured a session."""
    return [row["station"] for row in source.rows(_STATIONS, (session_id,))]


def all_observations(source: RowSource, session_ids: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return OBSERVATION_COLUMNS of used and excluded observations, oldest first, with joints and signals as columns.

    Args:
        source: the store.
        session_ids: the sessions; empty for all.
    """
    where = f"WHERE session_id IN ({marks(session_ids)})" if session_ids else ""
    rows = source.rows(
        f"SELECT {', '.join(OBSERVATION_COLUMNS)}, values_json FROM observations {where} ORDER BY id", session_ids
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
    """Return a station's fixes in a session, from the last one that calibration may use, or from its start.

    Returns:
        Rows of `fixes` with `excluded` of their observations; None where a fix is used or has no observation.
    """
    return iter(source.rows(_FIXES, (session_id, station)))


def newest_observation(source: RowSource, session_id: str) -> dict[str, Any] | None:
    """Return instant and `excluded` of the newest observation of a session that is open; None if it has none."""
    return next(iter(source.rows(_NEWEST, (session_id,))), None)


def last_standstills(source: RowSource, session_id: str, excluded: str, most: int) -> Iterator[dict[str, Any]]:
    """Return the observations of the last standstill of each run of the daemon in a session, oldest first.

    Args:
        source: the store.
        session_id: the session.
        excluded: beginning of a reason; observations that are excluded for another reason are left out.
        most: largest number of observations.

    Returns:
        pose, utc_ns, monotonic_ns, boot_id, x_mm, y_mm, z_mm, values_json and excluded of each.
    """
    return iter(source.rows(_LAST_STANDSTILLS, (session_id, f"{excluded}%", most)))
