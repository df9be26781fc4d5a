"""The store's table of calibration sessions: what is in it, and every way in which a session changes its state.

A session is open, then closed or aborted. When it is closed it is decided whether calibration may use it: where no
control point shows that the station stood still from its start to its end, it may not, until an operator accepts it.
Each change is one transaction.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping
from typing import Any

from daemon.caller import caller_columns
from daemon.control import CommandError
from daemon.open_session import OpenSession
from daemon.standstill_places import Exclusions
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import Fix

log = logging.getLogger(__name__)

NOT_SHOT = "no control point was shot at its start and again at its end, so nothing shows that the station stood still"
NOT_ENCLOSED = "most of its poses do not lie between a control point's shots at its start and at its end"
LEAST_ENCLOSED = 0.25  # of its poses; some come before the operator gets to the first shot, or after the last
CLOCK_STEP_NS = NS_PER_S // 20  # less may be the time between reading the one clock and the other

# Fixes of these may still come: of the open ones, and of those that ended after the oldest capture that waits to be
# decoded was made.
_UNFINISHED = """SELECT * FROM calibration_sessions
    WHERE state = 'open' OR (ended_boot_id, ended_monotonic_ns) >=
        (SELECT first_boot_id, first_monotonic_ns FROM raw_chunks
            WHERE id = (SELECT min(chunk_id) FROM undecoded_chunks))
    ORDER BY rowid"""
_SUMMARY = """SELECT id, rig, setup_id AS setup, prism, operator, caller_user AS user, kind, state, note,
        started_utc_ns, ended_utc_ns, excluded AS not_used, accepted_despite, accepted_by, accepted_utc_ns,
        accepted_caller_user AS accepted_user,
        (SELECT state = 'moved' FROM station_setups WHERE station_setups.id = setup_id) AS setup_moved
    FROM calibration_sessions WHERE id = ?"""
_COUNTS = """SELECT count(*) FILTER (WHERE excluded IS NULL) AS observations,
        count(DISTINCT pose) FILTER (WHERE excluded IS NULL) AS poses FROM observations WHERE session_id = ?"""
_EXCLUDED = """SELECT excluded AS reason, count(*) AS n FROM observations
    WHERE session_id = ? AND excluded IS NOT NULL GROUP BY excluded ORDER BY n DESC, reason"""
_SHOTS = "SELECT name AS point, phase, misclosure_mm FROM control_shots WHERE session_id = ? ORDER BY id"
_INSTANTS = """WITH instants AS (
        SELECT boot_id, monotonic_ns, utc_ns FROM observations WHERE session_id = ?1
        UNION ALL SELECT boot_id, monotonic_ns, utc_ns FROM control_shots WHERE session_id = ?1
        UNION ALL SELECT started_boot_id, started_monotonic_ns, started_utc_ns FROM calibration_sessions WHERE id = ?1
        UNION ALL SELECT ended_boot_id, ended_monotonic_ns, ended_utc_ns FROM calibration_sessions
            WHERE id = ?1 AND ended_utc_ns IS NOT NULL)"""
# Within a boot both clocks run alike, whatever NTP does to their rate: their difference changes only when the clock is
# set. A later boot must not show an earlier time. The first query is cheap, and nearly always the answer.
_MAY_HAVE_STEPPED = f"""{_INSTANTS} SELECT min(boot_id) < max(boot_id)
        OR max(utc_ns - monotonic_ns) - min(utc_ns - monotonic_ns) >= {CLOCK_STEP_NS} AS maybe FROM instants"""
_CLOCK_STEPS = f"""{_INSTANTS},
    pairs AS (SELECT utc_ns, utc_ns - lag(utc_ns) OVER earlier AS passed_ns,
            boot_id = lag(boot_id) OVER earlier AS is_same_boot,
            monotonic_ns - lag(monotonic_ns) OVER earlier AS true_ns
        FROM instants WINDOW earlier AS (ORDER BY boot_id, monotonic_ns)),
    steps AS (SELECT utc_ns, CASE WHEN is_same_boot THEN passed_ns - true_ns ELSE min(passed_ns, 0) END AS step_ns
        FROM pairs WHERE passed_ns IS NOT NULL)
    SELECT utc_ns AS at_utc_ns, step_ns FROM steps WHERE abs(step_ns) >= {CLOCK_STEP_NS}"""
# Poses, and those between two shots of a control point. Where the boom moves, each observation is a pose of its own.
_ENCLOSED = """SELECT count(DISTINCT coalesce(o.pose, o.id)) AS poses,
        count(DISTINCT CASE WHEN EXISTS (SELECT 1 FROM control_shots AS a JOIN control_shots AS b
                ON b.session_id = a.session_id AND b.name = a.name AND b.phase = 'end'
            WHERE a.session_id = o.session_id AND a.phase = 'start'
                AND (a.boot_id, a.monotonic_ns) < (o.boot_id, o.monotonic_ns)
                AND (o.boot_id, o.monotonic_ns) < (b.boot_id, b.monotonic_ns))
            THEN coalesce(o.pose, o.id) END) AS enclosed
    FROM observations AS o WHERE o.session_id = ? AND o.excluded IS NULL"""
_BETWEEN = """SELECT 1 FROM observations AS o JOIN control_shots AS c ON c.session_id = o.session_id AND c.name = ?
    WHERE o.session_id = ? AND o.excluded IS NULL
        AND (o.boot_id, o.monotonic_ns) > (c.boot_id, c.monotonic_ns) LIMIT 1"""
_JUMPED = """SELECT e.device, e.utc_ns, e.monotonic_ns, e.boot_id
    FROM device_events AS e JOIN calibration_sessions AS s ON s.id = ?
    WHERE e.kind = 'preset_jump' AND (e.boot_id, e.monotonic_ns) >= (s.started_boot_id, s.started_monotonic_ns)
    ORDER BY e.boot_id, e.monotonic_ns"""
_EXCLUDE = "UPDATE observations SET excluded = ? WHERE session_id = ? AND boot_id = ? AND monotonic_ns = ?"


class SessionTable:
    """The sessions of a store, and of one rig those that can be open.

    Args:
        store: where they are.
        rig_name: whose sessions are opened.
        clock: for when what happened.
        tolerance_mm: a control point further off than this says that the station moved.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock, tolerance_mm: float) -> None:
        self._store, self._rig, self._clock, self._tolerance_mm = store, rig_name, clock, tolerance_mm

    # ---- what is there -----------------------------------------------------------------------------------------------

    def unfinished(self) -> tuple[OpenSession | None, list[OpenSession]]:
        """The rig's open session, and those that have ended and whose last captures were not decoded yet."""
        opened: OpenSession | None = None
        ended: list[OpenSession] = []
        for row in self._store.rows(_UNFINISHED):
            if row["rig"] != self._rig:
                if row["state"] == "open":
                    log.warning(
                        "session %s of rig %s is open; it goes on when rigcal runs that rig", row["id"], row["rig"]
                    )
                continue
            since, until = self._store.stamp(row, "started_"), self._store.stamp(row, "ended_")
            assert since is not None  # the columns are NOT NULL
            order = self._store.order
            session = OpenSession(row["id"], row["setup_id"], row["prism"], row["kind"], order, since, until)
            if until is None:
                opened = session
            else:
                ended.append(session)
        return opened, ended

    def ids(self) -> set[str]:
        """All sessions of the store."""
        return {row["id"] for row in self._store.rows("SELECT id FROM calibration_sessions")}

    def free_id(self, prism: str) -> str:
        """A name that no session has."""
        taken = self.ids()
        return next(name for n in itertools.count(len(taken) + 1) if (name := f"s{n:03d}-{prism}") not in taken)

    def summary(self, session_id: str) -> dict[str, Any]:
        """One session: what it holds, what was excluded and why, and whether calibration uses it.

        Raises:
            CommandError: there is none.
        """
        with self._store.reader() as reader:
            return _summary(reader, session_id)

    def all(self) -> list[dict[str, Any]]:
        """All summaries, oldest first. Read beside the writing connection, which must not wait."""
        with self._store.reader() as reader:
            ids = [row["id"] for row in reader.rows("SELECT id FROM calibration_sessions ORDER BY rowid")]
            return [_summary(reader, session_id) for session_id in ids]

    def jobs(self, session_id: str) -> list[dict[str, Any]]:
        """The jobs that a session has triggered."""
        return self._store.rows(
            "SELECT id, kind, state, progress, message, error FROM jobs WHERE session_id = ? ORDER BY id", (session_id,)
        )

    def phase(self, session_id: str, point: str) -> str:
        """Return `end` for a control point that was shot before the observations so far, else `start`."""
        return "end" if self._store.rows(_BETWEEN, (point, session_id)) else "start"

    def shot(self, session_id: str, phase: str) -> set[str]:
        """Control points that were shot in a phase of a session."""
        rows = self._store.rows(
            "SELECT name FROM control_shots WHERE session_id = ? AND phase = ?", (session_id, phase)
        )
        return {row["name"] for row in rows}

    def jumped(self, session: OpenSession) -> dict[str, Stamp]:
        """Devices whose encoders have jumped in a session, since when."""
        jumped: dict[str, Stamp] = {}
        for row in self._store.rows(_JUMPED, (session.id,)):
            stamp = self._store.stamp(row)
            if stamp is not None and session.lasted(stamp):
                jumped.setdefault(row["device"], stamp)
        return jumped

    # ---- what changes ------------------------------------------------------------------------------------------------

    def start(self, row: Mapping[str, object], started: Stamp) -> None:
        """A session of the rig is open from now on."""
        opened = {"rig": self._rig, "state": "open", **self._store.instant(started, "started_")}
        self._store.insert("calibration_sessions", {**row, **opened})

    def end(self, session_id: str, state: str) -> Stamp:
        """A session is closed or aborted.

        Returns:
            When: no fix that was measured later is stored as its observation.
        """
        with self._store.transaction():
            ended = self._clock.now()  # in the transaction: the writer's thread may have held the store for long
            excluded = self._why_not_used(session_id) if state == "closed" else None
            changes = {"state": state, "excluded": excluded, **self._store.instant(ended, "ended_")}
            self._store.update("calibration_sessions", {"id": session_id}, changes)
        return ended

    def judge_again(self, session_id: str) -> None:
        """Decide anew whether calibration may use a closed session, of which more was decoded after its end."""
        with self._store.transaction():
            closed = {"id": session_id, "state": "closed", "accepted_despite": None}
            self._store.update("calibration_sessions", closed, {"excluded": self._why_not_used(session_id)})

    def accept(self, session_id: str, operator: str) -> str:
        """Calibration may use a closed session from now on, on an operator's word.

        Returns:
            What it was not used for.

        Raises:
            CommandError: there is none, it is not closed, or it is used anyway.
        """
        with self._store.transaction():
            found = self._store.rows("SELECT state, excluded FROM calibration_sessions WHERE id = ?", (session_id,))
            if not found:
                raise _unknown(session_id)
            state, despite = found[0]["state"], found[0]["excluded"]
            if state != "closed":
                why = "open; stop it first" if state == "open" else "aborted, and stays so"
                raise CommandError(f"session {session_id!r} is {why}")
            if despite is None:
                raise CommandError(f"session {session_id!r} is used by calibration; there is nothing to accept")
            (newest,) = self._store.rows("SELECT coalesce(max(id), 0) AS job FROM jobs")
            word = {
                "excluded": None,
                "accepted_despite": despite,
                "accepted_by": operator,
                "accepted_after_job": newest["job"],
                **caller_columns("accepted_"),
            }
            accepted = self._store.instant(self._clock.now(), "accepted_")
            self._store.update("calibration_sessions", {"id": session_id}, {**word, **accepted})
        return str(despite)

    def add_observation(self, row: Mapping[str, object], fix: Fix, measured: Stamp) -> None:
        """An observation that a fix gives."""
        more = {"fix_id": self._store.fix_id(fix), **self._store.instant(measured)}
        self._store.insert("observations", {**row, **more})

    def exclude(self, session_id: str, exclusions: Exclusions, newest: Stamp) -> None:
        """Change why observations of a session must not be used; their instants are of the boot of the newest."""
        with self._store.transaction() as db:
            boot = self._store.boot_row(newest)
            rows = [(excluded, session_id, boot, at_ns) for at_ns, excluded in exclusions.items()]
            db.conn.executemany(_EXCLUDE, rows)

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _why_not_used(self, session_id: str) -> str | None:
        """Why calibration must not use a session, a clause; None where a control point shows that it may."""
        shots = self._store.rows(_SHOTS, (session_id,))
        for shot in shots:
            if shot["misclosure_mm"] is not None and shot["misclosure_mm"] > self._tolerance_mm:
                off = f"control point {shot['point']} was {shot['misclosure_mm']:.1f} mm off at its {shot['phase']}"
                return f"{off}, so the station had moved"
        if not self.shot(session_id, "start") & self.shot(session_id, "end"):
            return NOT_SHOT
        (found,) = self._store.rows(_ENCLOSED, (session_id,))
        return NOT_ENCLOSED if found["enclosed"] < LEAST_ENCLOSED * found["poses"] else None


def _summary(reader: Reader, session_id: str) -> dict[str, Any]:
    found = list(reader.rows(_SUMMARY, (session_id,)))
    if not found:
        raise _unknown(session_id)
    row = found[0]
    accepted = {key: row.pop(f"accepted_{key}") for key in ("despite", "by", "user", "utc_ns")}
    (counts,) = reader.rows(_COUNTS, (session_id,))
    steps = _clock_steps(reader, session_id)
    return {
        **row,
        **counts,
        "setup_moved": bool(row["setup_moved"]),
        "accepted": accepted if accepted["despite"] is not None else None,
        "excluded": {e["reason"]: e["n"] for e in reader.rows(_EXCLUDED, (session_id,))},
        "control_shots": list(reader.rows(_SHOTS, (session_id,))),
        "clock_steps": steps,
        "utc_ran_backwards": any(step["step_s"] < 0 for step in steps),
    }


def _clock_steps(reader: Reader, session_id: str) -> list[dict[str, Any]]:
    """When, and by how much, the computer's clock was set during a session."""
    (found,) = reader.rows(_MAY_HAVE_STEPPED, (session_id,))
    if not found["maybe"]:
        return []
    steps = reader.rows(_CLOCK_STEPS, (session_id,))
    return [{"at_utc_ns": step["at_utc_ns"], "step_s": step["step_ns"] / NS_PER_S} for step in steps]


def _unknown(session_id: str) -> CommandError:
    return CommandError(f"there is no session {session_id!r:.80}; `rigcal session list` shows them")
