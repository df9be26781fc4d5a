"""The tables of calibration sessions: sessions, their control shots, and confirmations of their prism."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from daemon.commands import OTHER_RIG_FILE
from daemon.host.time_service import ClockState
from daemon.store.connection import Connection
from daemon.store.errors import NotInStoreError
from daemon.store.places import between
from daemon.store.queries.decoding import OLDEST_WAITING
from daemon.store.queries.observations import Tally, tally_of
from daemon.store.queries.zeros import Zeros, newest_jumps
from daemon.store.rows import RowSource, marks
from daemon.store.views import in_session
from drivers.clock import NS_PER_S, Stamp

SESSION_COLUMNS = (
    *("id", "rig", "setup_id", "prism", "kind", "state", "operator", "note", "started_utc_ns", "ended_utc_ns"),
    "not_used",
)
# Why calibration does not use a session, a clause; NULL if it does. All queries of used sessions are made from this.
_NOT_USED = """CASE state WHEN 'open' THEN 'it is still open' WHEN 'aborted' THEN 'it was aborted' ELSE excluded END"""
_USED = f"SELECT rowid AS number, * FROM calibration_sessions WHERE ({_NOT_USED}) IS NULL"
BEFORE_NS = 60 * NS_PER_S  # dwell and direction of a session's first fixes depend on motion before it
AFTER_NS = 2 * NS_PER_S  # a session's last fixes are interpolated between joint readings up to this time after it
CLOCK_STEP_NS = NS_PER_S // 20  # a smaller difference may be the time between reading the two clocks

# Sessions that may still get fixes: open ones, and those that ended after the oldest capture that waits to be decoded.
_IS_UNDECODED = f"(ended_boot_id, ended_monotonic_ns) >= ({OLDEST_WAITING})"
_UNFINISHED = f"SELECT * FROM calibration_sessions WHERE state = 'open' OR {_IS_UNDECODED} ORDER BY rowid"
_SUMMARY = """SELECT id, rig, setup_id AS setup, prism, operator, caller_user AS user, kind, state, note,
        started_utc_ns, ended_utc_ns, excluded AS not_used, accepted_despite, accepted_by, accepted_utc_ns,
        accepted_caller_user AS accepted_user,
        rejected_reason, rejected_by, rejected_caller_user AS rejected_user, rejected_utc_ns,
        (SELECT state = 'moved' FROM station_setups WHERE station_setups.id = setup_id) AS setup_moved
    FROM calibration_sessions WHERE id = ?"""
_SHOTS = "SELECT name AS point, phase, misclosure_mm FROM control_shots WHERE session_id = ? ORDER BY id"
_OTHER_INSTANTS = """SELECT boot_id, monotonic_ns, utc_ns, 0 AS is_before FROM control_shots WHERE session_id = ?1
        UNION ALL SELECT started_boot_id, started_monotonic_ns, started_utc_ns, 0 FROM calibration_sessions
            WHERE id = ?1
        UNION ALL SELECT ended_boot_id, ended_monotonic_ns, ended_utc_ns, 0 FROM calibration_sessions
            WHERE id = ?1 AND ended_utc_ns IS NOT NULL
        UNION ALL SELECT * FROM (SELECT ended_boot_id, ended_monotonic_ns, ended_utc_ns, 1 FROM calibration_sessions
            WHERE ended_utc_ns IS NOT NULL AND rowid < (SELECT rowid FROM calibration_sessions WHERE id = ?1)
            ORDER BY rowid DESC LIMIT 1)"""
# Prefixes of the reason why a session is not used: it was recorded with a different rig file, or before a joint's zero
# was lost. Stored reasons are compared with these prefixes, so they must not change.
ZERO_LOST = "an encoder has jumped since, and nobody has checked its zero: "
# Beginnings of reasons that only an operator can end, as nothing else in the store shows them
OPEN_IN_BACKUP = "the session was open in the backup"
OPEN_AT_NEXT = "it was still open when session "
# Within a boot both clocks run at the same rate, whatever NTP does, so their difference changes only when the clock is
# set. A later boot must not show an earlier time. For the time since the end of the previous session only backward
# steps count, because a computer that was suspended is ahead. The first query is cheap, and nearly always sufficient
# together with the tally of observations.
_CLOCK_RANGE = f"""SELECT min(boot_id), max(boot_id), min(utc_ns - monotonic_ns), max(utc_ns - monotonic_ns), count(*)
    FROM ({_OTHER_INSTANTS})"""
_CLOCK_NOW = "SELECT utc_ns - monotonic_ns AS now_ns FROM observations WHERE id = ?"
_CLOCK_STEPS = f"""WITH instants AS (
        SELECT boot_id, monotonic_ns, utc_ns, 0 AS is_before FROM observations WHERE session_id = ?1
        UNION ALL {_OTHER_INSTANTS}),
    pairs AS (SELECT utc_ns, utc_ns - lag(utc_ns) OVER earlier AS passed_ns,
            boot_id = lag(boot_id) OVER earlier AS is_same_boot,
            lag(is_before) OVER earlier AS is_between, monotonic_ns - lag(monotonic_ns) OVER earlier AS true_ns
        FROM instants WINDOW earlier AS (ORDER BY boot_id, monotonic_ns, is_before DESC)),
    sizes AS (SELECT utc_ns, is_between OR NOT is_same_boot AS is_back_only,
            CASE WHEN is_same_boot THEN passed_ns - true_ns ELSE passed_ns END AS step_ns
        FROM pairs WHERE passed_ns IS NOT NULL),
    steps AS (SELECT utc_ns, CASE WHEN is_back_only THEN min(step_ns, 0) ELSE step_ns END AS step_ns FROM sizes)
    SELECT utc_ns AS at_utc_ns, step_ns FROM steps WHERE abs(step_ns) >= {CLOCK_STEP_NS}"""
_CLOCKS = """SELECT phase, synchronized AS is_synchronized, offset_s, max_error_s, source, error
    FROM session_clocks WHERE session_id = ?"""
# Largest distance between shots of a control point with poses in between. Of successive shots without poses in between
# the last one is used, because it was repeated after a bad shot.
_MOVED_BETWEEN = f"""WITH counted AS (SELECT s.id, s.name, s.x_mm, s.y_mm, s.z_mm FROM control_shots AS s
        WHERE s.session_id = ?1 AND NOT EXISTS (SELECT 1 FROM control_shots AS c
            WHERE c.session_id = ?1 AND c.name = s.name AND c.id > s.id AND NOT EXISTS (
                SELECT 1 FROM boots CROSS JOIN observations AS o WHERE o.session_id = ?1 AND o.excluded IS NULL
                    AND {between("o.", ("s.boot_id", "s.monotonic_ns + 1"), ("c.boot_id", "c.monotonic_ns - 1"))})))
    SELECT a.name AS point, max((a.x_mm - b.x_mm) * (a.x_mm - b.x_mm) + (a.y_mm - b.y_mm) * (a.y_mm - b.y_mm)
            + (a.z_mm - b.z_mm) * (a.z_mm - b.z_mm)) AS square_mm2
    FROM counted AS a JOIN counted AS b ON b.name = a.name AND b.id > a.id"""
_BETWEEN = """SELECT 1 FROM observations AS o JOIN control_shots AS c ON c.session_id = o.session_id AND c.name = ?
    WHERE o.session_id = ? AND o.excluded IS NULL
        AND (o.boot_id, o.monotonic_ns) > (c.boot_id, c.monotonic_ns) LIMIT 1"""
# The newest observation of each standstill, by session, from an instant on. The inner query follows the index, newest
# first, and ends early, however long the sessions are.
_STANDSTILLS = """SELECT id, session_id, prism, x_mm, y_mm, z_mm, values_json FROM observations WHERE id IN (
    SELECT max(id) AS newest FROM (SELECT o.id, o.session_id, o.pose
            FROM calibration_sessions AS s CROSS JOIN observations AS o ON o.session_id = s.id
            WHERE s.setup_id = ? AND s.rig = ? AND s.state != 'aborted' AND o.excluded IS NULL AND o.pose IS NOT NULL
                AND s.rejected_utc_ns IS NULL AND coalesce(s.excluded, '') NOT LIKE ?
                AND (o.boot_id, o.monotonic_ns) >= (?, ?)
            ORDER BY s.rowid DESC, o.boot_id DESC, o.monotonic_ns DESC LIMIT 50000)
        GROUP BY session_id, pose ORDER BY newest DESC LIMIT 500)
    ORDER BY id"""
# Sessions after the newest used session; later measurements replace earlier ones.
_UNTRAINED = f"""SELECT id, excluded FROM calibration_sessions
    WHERE rig = ?1 AND state = 'closed' AND excluded IS NOT NULL AND excluded NOT LIKE '{OTHER_RIG_FILE}%'
        AND excluded NOT LIKE '{ZERO_LOST}%' AND rejected_utc_ns IS NULL AND rowid >
        (SELECT coalesce(max(number), 0) FROM ({_USED}) WHERE rig = ?1)
    ORDER BY rowid"""
_WITH_RIG = """SELECT calibration_sessions.*, rig_files.text AS rig_text FROM calibration_sessions
    LEFT JOIN rig_files ON rig_files.sha256 = rig_sha256"""
_SESSION = f"{_WITH_RIG} WHERE id = ?"
_BETWEEN_INSTANTS = f"""{_WITH_RIG} WHERE (started_boot_id, started_monotonic_ns) <= (?, ?)
        AND (ended_boot_id IS NULL OR (ended_boot_id, ended_monotonic_ns) >= (?, ?))"""
# Rows measured from a session's start to its end, found by the index of the table behind the view.
_FIXES_MEASURED = f"""SELECT row.* {in_session("links CROSS JOIN v_fixes")} AND row.station = links.name
    ORDER BY row.id"""
_JOINTS_MEASURED = f"SELECT row.* {in_session('v_joints')} ORDER BY row.boot_id, row.monotonic_ns"
# When a session last got a fix or a shot, or the end of the run of the daemon in which it did, whichever is later.
_LAST_MEASURED = """WITH measured AS (SELECT * FROM (
            SELECT utc_ns, monotonic_ns, boot_id FROM control_shots WHERE session_id = ?1
            UNION ALL SELECT started_utc_ns, started_monotonic_ns, started_boot_id FROM calibration_sessions
                WHERE id = ?1
            UNION ALL SELECT * FROM (SELECT utc_ns, monotonic_ns, boot_id FROM observations WHERE session_id = ?1
                ORDER BY boot_id DESC, monotonic_ns DESC LIMIT 1))
        ORDER BY boot_id DESC, monotonic_ns DESC LIMIT 1)
    SELECT * FROM (SELECT * FROM measured UNION ALL SELECT * FROM (
            SELECT run.alive_utc_ns, run.alive_monotonic_ns, run.alive_boot_id FROM daemon_runs AS run, measured
            WHERE (run.started_boot_id, run.started_monotonic_ns) <= (measured.boot_id, measured.monotonic_ns)
            ORDER BY run.id DESC LIMIT 1))
    ORDER BY boot_id DESC, monotonic_ns DESC LIMIT 1"""
_ZEROS_KNOWN = """started_utc_ns, started_monotonic_ns, started_boot_id,
        accepted_utc_ns, accepted_monotonic_ns, accepted_boot_id"""  # the columns that `zeros_known` reads
_OPEN = """SELECT id, started_utc_ns, started_monotonic_ns, started_boot_id FROM calibration_sessions
    WHERE rig = ? AND state = 'open' ORDER BY rowid DESC LIMIT 1"""


@dataclass(frozen=True)
class OpenSessionRow:
    """The open session.

    Attributes:
        id: id of the session.
        started: when it was opened.
        jumped: names of the devices whose encoders have jumped since.
    """

    id: str
    started: Stamp
    jumped: tuple[str, ...] = ()


class SessionTable:
    """The sessions of a store, and the one of a rig that may be open.

    Args:
        store: the database.
        rig_name: name of the rig.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name

    # ---- sessions ----------------------------------------------------------------------------------------------------

    def ids(self) -> set[str]:
        """Return the ids of all sessions in the store."""
        return {row["id"] for row in self._store.rows("SELECT id FROM calibration_sessions")}

    def free_id(self, prism: str) -> str:
        """Return an unused id for a session of a prism."""
        taken = self.ids()
        return next(name for n in itertools.count(len(taken) + 1) if (name := f"s{n:03d}-{prism}") not in taken)

    def summary(self, session_id: str, count: Callable[[RowSource, str], Tally] = tally_of) -> dict[str, Any]:
        """Return a summary of one session: its observations, exclusions with reasons, and whether calibration uses it.

        Args:
            session_id: the session.
            count: counts its observations.

        Raises:
            NotInStoreError: there is no such session.
        """
        return _summary(self._store, session_id, count)

    def all(self) -> list[dict[str, Any]]:
        """Return all summaries, oldest first, read on a separate connection so that the writing one does not wait."""
        with self._store.reader() as reader:
            ids = [row["id"] for row in reader.rows("SELECT id FROM calibration_sessions ORDER BY rowid")]
            return [_summary(reader, session_id) for session_id in ids]

    def unfinished(self) -> list[dict[str, Any]]:
        """Return the sessions that may still get fixes: open ones, and those whose captures are not all decoded."""
        return self._store.rows(_UNFINISHED)

    def follower(self, session_id: str) -> str | None:
        """Return the session that was started next after one, whatever its rig; None if there is none."""
        sql = """SELECT id FROM calibration_sessions
            WHERE rowid > (SELECT rowid FROM calibration_sessions WHERE id = ?) ORDER BY rowid LIMIT 1"""
        return next((row["id"] for row in self._store.rows(sql, (session_id,))), None)

    def last_measured(self, session_id: str) -> Stamp:
        """Return the end of the last run of the daemon that measured in a session."""
        (row,) = self._store.rows(_LAST_MEASURED, (session_id,))
        return self._store.stamp(row)

    def open_session(self) -> OpenSessionRow | None:
        """Return the rig's open session; None without one."""
        rows = self._store.rows(_OPEN, (self._rig,))
        if not rows:
            return None
        started = self._store.stamp(rows[0], "started_")
        jumps = newest_jumps(self._store, started)
        return OpenSessionRow(rows[0]["id"], started, tuple(jump.device for jump in jumps))

    def used(self) -> list[dict[str, Any]]:
        """Return id and kind of the rig's closed sessions that calibration may use, oldest first."""
        return self._store.rows(f"SELECT id, kind FROM ({_USED}) WHERE rig = ? ORDER BY number", (self._rig,))

    def used_like(self, session_id: str) -> str | None:
        """Return the newest other session of the same prism in the same set-up that calibration may use, if any."""
        sql = f"""SELECT other.id FROM calibration_sessions AS own JOIN ({_USED}) AS other
                ON other.setup_id = own.setup_id AND other.prism = own.prism AND other.id <> own.id
            WHERE own.id = ? ORDER BY other.number DESC LIMIT 1"""
        return next((row["id"] for row in self._store.rows(sql, (session_id,))), None)

    def closed(self) -> list[dict[str, Any]]:
        """Return the rig's closed sessions, oldest first: id, excluded, accepted_despite, for `zeros_known`."""
        sql = f"""SELECT id, excluded, accepted_despite, {_ZEROS_KNOWN} FROM calibration_sessions
            WHERE rig = ? AND state = 'closed' ORDER BY rowid"""
        return self._store.rows(sql, (self._rig,))

    def untrained(self) -> dict[str, str]:
        """Return the rig's closed sessions newer than all used ones that calibration does not use -> why.

        Sessions recorded with a different rig file, or before a joint's zero was lost, are left out as outdated, and so
        are sessions that an operator has rejected.
        """
        return {row["id"]: row["excluded"] for row in self._store.rows(_UNTRAINED, (self._rig,))}

    def newest_number(self) -> int:
        """Return the number of the rig's newest session; 0 before the first."""
        sql = "SELECT coalesce(max(rowid), 0) FROM calibration_sessions WHERE rig = ?"
        return self._store.number(sql, (self._rig,)) or 0

    def newest_start(self, session_ids: Collection[str]) -> Stamp | None:
        """Return when the newest of some sessions was started; None if there is none."""
        rows = self._store.rows(
            "SELECT id, started_utc_ns, started_monotonic_ns, started_boot_id FROM calibration_sessions WHERE rig = ? "
            "ORDER BY rowid DESC",
            (self._rig,),
        )
        return next((self._store.stamp(row, "started_") for row in rows if row["id"] in session_ids), None)

    def zeros_lost(self) -> list[str]:
        """Return devices that jumped, unchecked, since the newest session started that is not aborted or rejected."""
        sql = f"""SELECT {_ZEROS_KNOWN} FROM calibration_sessions
            WHERE rig = ? AND state IN ('open', 'closed') AND rejected_utc_ns IS NULL ORDER BY rowid DESC LIMIT 1"""
        rows = self._store.rows(sql, (self._rig,))
        return [*Zeros(self._store, self._rig).lost(self.zeros_known(rows[0]))] if rows else []

    def zeros_known(self, session: Mapping[str, Any]) -> Stamp:
        """Return when the zeros of a session were last known: at its start, or when an operator accepted it."""
        return self._store.stamp_or_none(session, "accepted_") or self._store.stamp(session, "started_")

    def rig_of(self, session_ids: Sequence[str]) -> str | None:
        """Return the SHA-256 of the rig file of the newest of some sessions; None if there is none."""
        sql = f"SELECT rig_sha256 FROM calibration_sessions WHERE id IN ({marks(session_ids)}) ORDER BY rowid DESC"
        return next((row["rig_sha256"] for row in self._store.rows(sql, session_ids)), None)

    def state_and_exclusion(self, session_id: str) -> tuple[str, str | None]:
        """Return the state of a session, and why calibration does not use it; None if it may.

        Raises:
            NotInStoreError: there is no such session.
        """
        found = self._store.rows("SELECT state, excluded FROM calibration_sessions WHERE id = ?", (session_id,))
        if not found:
            raise _unknown(session_id)
        return found[0]["state"], found[0]["excluded"]

    def start(self, started: Stamp, rig_text: str, **columns: object) -> None:
        """Add an open session of the rig.

        Args:
            started: start of the session.
            rig_text: the rig file.
            columns: further columns of its row.
        """
        row = {**columns, "rig": self._rig, "state": "open", **self._store.instant(started, "started_")}
        with self._store.transaction():
            sha256 = self._store.rig_file(self._rig, rig_text)
            self._store.insert("calibration_sessions", {**row, "rig_sha256": sha256})

    def note_clock(self, session_id: str, phase: str, state: ClockState) -> None:
        """Store the state of the computer's clock at a session's `start` or `end`."""
        told = asdict(state)
        row = {"session_id": session_id, "phase": phase, "synchronized": told.pop("is_synchronized"), **told}
        self._store.insert("session_clocks", row)

    def change(self, session_id: str, **columns: object) -> None:
        """Change columns of a session."""
        self._store.update("calibration_sessions", {"id": session_id}, columns)

    def exclude_closed(self, session_id: str, excluded: str | None) -> None:
        """Set why calibration must not use a session, if it is closed and no operator has accepted it."""
        closed = {"id": session_id, "state": "closed", "accepted_despite": None}
        self._store.update("calibration_sessions", closed, {"excluded": excluded})

    # ---- control shots -----------------------------------------------------------------------------------------------

    def phase(self, session_id: str, point: str) -> str:
        """Return `end` for a control point that has a shot before some of the session's observations, else `start`."""
        return "end" if self._store.rows(_BETWEEN, (point, session_id)) else "start"

    def points_shot(self, session_id: str, phase: str) -> set[str]:
        """Return the control points that were shot in a phase of a session."""
        return {shot["point"] for shot in self.shots(session_id) if shot["phase"] == phase}

    def shots(self, session_id: str) -> list[dict[str, Any]]:
        """Return point, phase and misclosure_mm of a session's control shots, oldest first."""
        return self._store.rows(_SHOTS, (session_id,))

    def moved_between(self, session_id: str) -> tuple[str, float] | None:
        """Return the control point that moved most between shots with poses in between, and how far, mm; or None."""
        (found,) = self._store.rows(_MOVED_BETWEEN, (session_id,))
        return None if found["point"] is None else (found["point"], math.sqrt(found["square_mm2"]))

    # ---- their prism ------------------------------------------------------------------------------------------------

    def standstill_observations(self, setup_id: str, since: Stamp | None) -> list[dict[str, Any]]:
        """Return the newest used observation of each standstill in a set-up, oldest first.

        Sessions that were recorded with a different rig file, or rejected by an operator, are left out.

        Args:
            setup_id: set-up of the station.
            since: earlier observations are left out; None for no limit.

        Returns:
            session_id, prism, x_mm, y_mm, z_mm and values_json of each, at most 500, among the newest 50,000 fixes.
        """
        first = (0, 0) if since is None else self._store.order(since)
        return self._store.rows(_STANDSTILLS, (setup_id, self._rig, f"{OTHER_RIG_FILE}%", *first))

    def add_confirmation(self, session_id: str, at: Stamp, **columns: object) -> None:
        """Add a confirmation that the session's stations are on its prism: with `operator` and caller, or `turning`."""
        row = {"session_id": session_id, **self._store.instant(at), **columns}
        self._store.insert("prism_confirmations", row)


# ---- for the writing connection and for readers ----------------------------------------------------------------------


def session(source: RowSource, session_id: str) -> dict[str, Any] | None:
    """Return a session's row with its `rig_text`; None if there is no such session."""
    return next(iter(source.rows(_SESSION, (session_id,))), None)


def sessions_between(source: RowSource, since: Stamp, until: Stamp, boot: int) -> list[dict[str, Any]]:
    """Return the rows of sessions, in the form of `session`, that were open between two instants of a boot.

    Args:
        source: the store.
        since: the first instant.
        until: the last instant.
        boot: row of `boots`.
    """
    first, last = (boot, since.monotonic_ns), (boot, until.monotonic_ns)
    return list(source.rows(_BETWEEN_INSTANTS, (*last, *first)))


def all_sessions(source: RowSource) -> list[dict[str, Any]]:
    """Return SESSION_COLUMNS of every session, oldest first; `not_used` is None if calibration uses it."""
    names = ", ".join(SESSION_COLUMNS[:-1])
    return list(source.rows(f"SELECT {names}, {_NOT_USED} AS not_used FROM calibration_sessions ORDER BY rowid"))


def sessions_of_use(source: RowSource) -> tuple[list[str], list[str]]:
    """Return the closed sessions that calibration may use, oldest first: training sessions and check sessions."""
    rows = source.rows(f"SELECT id, kind FROM ({_USED}) ORDER BY number")
    found = [(row["id"], row["kind"] == "check") for row in rows]
    return [name for name, is_check in found if not is_check], [name for name, is_check in found if is_check]


def prism_confirmations(source: RowSource, session_id: str) -> list[dict[str, Any]]:
    """Return the confirmations that a session's stations are on its prism, oldest first."""
    return list(source.rows("SELECT * FROM prism_confirmations WHERE session_id = ? ORDER BY id", (session_id,)))


def joints_measured(source: RowSource, session_id: str) -> Iterator[dict[str, Any]]:
    """Return the rows of `v_joints` from the start of a session that has ended to its end, oldest first."""
    return iter(source.rows(_JOINTS_MEASURED, (session_id,)))


def fixes_measured(source: RowSource, session_id: str) -> Iterator[dict[str, Any]]:
    """Return the rows of `v_fixes` from the start of a session that has ended to its end, oldest first."""
    return iter(source.rows(_FIXES_MEASURED, (session_id,)))


def _summary(source: RowSource, session_id: str, count: Callable[[RowSource, str], Tally] = tally_of) -> dict[str, Any]:
    row = next(iter(source.rows(_SUMMARY, (session_id,))), None)
    if row is None:
        raise _unknown(session_id)
    accepted = {key: row.pop(f"accepted_{key}") for key in ("despite", "by", "user", "utc_ns")}
    rejected = {key: row.pop(f"rejected_{key}") for key in ("reason", "by", "user", "utc_ns")}
    tally = count(source, session_id)
    steps = _clock_steps(source, tally)
    return {
        **row,
        "observations": tally.used,
        "poses": len(tally.poses),
        "setup_moved": bool(row["setup_moved"]),
        "accepted": accepted if accepted["despite"] is not None else None,
        "rejected": rejected if rejected["utc_ns"] is not None else None,
        "excluded": dict(sorted(tally.excluded.items(), key=lambda item: (-item[1], item[0]))),
        "control_shots": list(source.rows(_SHOTS, (session_id,))),
        "clock": _clocks(source, session_id),
        "clock_steps": steps,
        "utc_ran_backwards": any(step["step_s"] < 0 for step in steps),
    }


def _clocks(source: RowSource, session_id: str) -> dict[str, dict[str, Any] | None]:
    """Return the state of the computer's clock at a session's start and end; None where it was not stored."""
    found: dict[str, dict[str, Any] | None] = {"start": None, "end": None}
    for row in source.rows(_CLOCKS, (session_id,)):
        phase, flag = row.pop("phase"), row["is_synchronized"]
        found[phase] = {**row, "is_synchronized": None if flag is None else bool(flag)}
    return found


def _clock_steps(source: RowSource, tally: Tally) -> list[dict[str, Any]]:
    """Return when and by how much the computer's clock was set during a session, or set back before it."""
    (found,) = source.rows(_CLOCK_RANGE, (tally.session_id,))
    *clock, instants = found.values()
    first, last, least_ns, most_ns = seen = tally.clock_with(clock)
    if first == last and most_ns - least_ns < CLOCK_STEP_NS:
        return []
    now_ns = [row["now_ns"] for row in source.rows(_CLOCK_NOW, (tally.through,))]
    shown = seen, instants, *(round(one / CLOCK_STEP_NS) for one in now_ns)
    if shown not in tally.steps:  # computed again only when the clocks show something other than last time
        steps = [*source.rows(_CLOCK_STEPS, (tally.session_id,))]
        tally.steps.clear()
        tally.steps[shown] = [{"at_utc_ns": s["at_utc_ns"], "step_s": s["step_ns"] / NS_PER_S} for s in steps]
    return tally.steps[shown]


def _unknown(session_id: str) -> NotInStoreError:
    return NotInStoreError(f"there is no session {session_id!r:.80}; `rigcal session list` shows them")
