"""The table of jobs: queries for scheduling, running and showing them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from daemon.commands import CHECK
from daemon.store.connection import Connection
from daemon.store.errors import NotInStoreError
from daemon.store.queries.models import ModelRow
from daemon.store.rows import marks
from drivers.clock import NS_PER_S, Clock, Stamp

# Scheduling runs twice a second in parallel with acquisition, for months. CROSS JOIN and NOT INDEXED keep SQLite's
# planner from starting with all of a rig's sessions.
# The newest session of each kind and state that calibration may use; the index contains all columns of the query.
_SESSIONS = """SELECT id, rowid AS number, kind, state, ended_utc_ns, ended_monotonic_ns, ended_boot_id
    FROM calibration_sessions WHERE rowid IN
        (SELECT max(rowid) FROM calibration_sessions
            WHERE rig = ? AND state IN ('open', 'closed') AND excluded IS NULL GROUP BY state, kind)
    ORDER BY rowid"""
_PENDING = """SELECT job.id, job.kind, job.session_id, job.state, job.attempts,
        job.depends_on IS NULL OR before.state = 'done' AS is_ready,
        job.ended_utc_ns, job.ended_monotonic_ns, job.ended_boot_id, job.interruptions
    FROM jobs AS job CROSS JOIN calibration_sessions AS session ON session.id = job.session_id
        LEFT JOIN jobs AS before ON before.id = job.depends_on
    WHERE job.state IN ('queued', 'running', 'interrupted') AND session.rig = ? ORDER BY job.id"""
# Goes back from the newest session to one through which a job of this kind was queued, or that no longer matters. A job
# that was queued before an operator accepted a session, or rejected a used one, does not work on the sessions that are
# used now, and no longer covers anything. Training after a drift uses checks as well, so a rejected one counts for it.
_COVERED = f"""SELECT session.rowid AS number FROM calibration_sessions AS session NOT INDEXED
    WHERE session.rig = ?1 AND session.rowid > ?2
        AND EXISTS (SELECT 1 FROM jobs WHERE jobs.through_session_id = session.id AND jobs.kind = ?3 AND jobs.id >
            (SELECT coalesce(max(accepted_after_job), 0) FROM calibration_sessions
                WHERE rig = ?1 AND accepted_after_job IS NOT NULL
                    AND ((kind = '{CHECK}') = ?4 OR rejected_utc_ns IS NOT NULL AND NOT ?4)))
    ORDER BY session.rowid DESC LIMIT 1"""
_NEWEST = """SELECT job.id, job.session_id, job.ended_utc_ns, job.result_json, job.error FROM jobs AS job
    JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.kind = ? AND job.state = ? AND session.rig = ? ORDER BY job.id DESC LIMIT 1"""
_WORKED_ON = """SELECT rowid AS number, id, kind FROM calibration_sessions WHERE rig = ? AND state = 'closed'
        AND excluded IS NULL AND coalesce(accepted_after_job, 0) < ?
        AND rowid <= (SELECT rowid FROM calibration_sessions WHERE id = ?)
    ORDER BY rowid"""
_CHAIN = """WITH RECURSIVE chain(id) AS (VALUES (?) UNION SELECT jobs.id FROM jobs JOIN chain ON depends_on = chain.id)
    SELECT id, state FROM chain JOIN jobs USING (id) ORDER BY id"""
_FAILED = """SELECT max(job.id) AS id, job.kind, job.error FROM jobs AS job
    CROSS JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = 'failed' AND session.rig = ? GROUP BY job.kind ORDER BY job.id"""
_DONE_LATER = """SELECT 1 FROM jobs AS job CROSS JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = 'done' AND job.id > ? AND job.kind = ? AND session.rig = ? LIMIT 1"""
# The first job of some kinds that works on a session: it was queued after the session ended or was accepted.
_FIRST_ON = """SELECT job.id, job.session_id FROM jobs AS job
    JOIN calibration_sessions AS through ON through.id = job.through_session_id
    JOIN calibration_sessions AS session ON session.id = ?1
    WHERE job.kind IN ({kinds}) AND through.rig = session.rig AND through.rowid >= session.rowid
        AND job.id > coalesce(session.accepted_after_job, 0) ORDER BY job.id LIMIT 1"""
_SHOWN = """id, kind, session_id, state, progress, message, attempts, error,
    created_utc_ns, started_utc_ns, ended_utc_ns,
    CASE WHEN started_boot_id = ended_boot_id THEN (ended_monotonic_ns - started_monotonic_ns) / 1e9
        ELSE (ended_utc_ns - started_utc_ns) / 1e9 END AS duration_s"""


class JobKind(StrEnum):
    """Kind of a job."""

    GAP = "gap"
    RESIDUAL = "residual"
    REPORT = "report"
    COMPARISON = "comparison"
    DRIFT = "drift"


@dataclass(frozen=True)
class SessionFacts:
    """The facts of a calibration session that scheduling needs.

    Attributes:
        id: id of the session.
        number: increases from one session to the next. One is open at a time, so they end in the order of their start.
        kind: single_joint, multi_joint, static_poses or check.
        state: open, closed or aborted.
        ended: when it was closed; None while open.
    """

    id: str
    number: int
    kind: str
    state: str
    ended: Stamp | None


@dataclass(frozen=True)
class JobFacts:
    """The facts of an unfinished job that scheduling needs.

    Attributes:
        id: number of the job.
        kind: see JobKind.
        session_id: the session that triggered it.
        state: queued, running or interrupted.
        attempts: number of attempts.
        is_ready: whether the job that it depends on, if any, is done.
        ended: when it was last interrupted.
        interruptions: number of interruptions that do not count as attempts: a shutdown of the computer, a full disk.
    """

    id: int
    kind: JobKind
    session_id: str
    state: str
    attempts: int
    is_ready: bool
    ended: Stamp | None
    interruptions: int = 0


@dataclass(frozen=True)
class FailedJob:
    """The newest failed job of its kind, if no later job of the kind is done.

    Attributes:
        id, kind: number and kind of the job.
        error: why it failed.
    """

    id: int
    kind: str
    error: str


class JobTable:
    """The jobs of one rig.

    Args:
        store: the database.
        rig_name: name of the rig.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name

    # ---- for scheduling ----------------------------------------------------------------------------------------------

    def newest_sessions(self) -> list[SessionFacts]:
        """Return the newest session of each kind and state that calibration may use, in order of their start."""
        rows = self._store.rows(_SESSIONS, (self._rig,))
        return [
            SessionFacts(row["id"], row["number"], row["kind"], row["state"], self._store.stamp_or_none(row, "ended_"))
            for row in rows
        ]

    def pending(self) -> list[JobFacts]:
        """Return the unfinished jobs, in order of creation."""
        return [
            JobFacts(
                row["id"],
                JobKind(row["kind"]),
                row["session_id"],
                row["state"],
                row["attempts"],
                bool(row["is_ready"]),
                self._store.stamp_or_none(row, "ended_"),
                row["interruptions"],
            )
            for row in self._store.rows(_PENDING, (self._rig,))
        ]

    def covered(self, kind: JobKind, after_session: int) -> int | None:
        """Return the number of the newest session that a job of a kind works on; None if there is none.

        Args:
            kind: kind of the job.
            after_session: sessions up to this number are ignored.
        """
        return self._store.number(_COVERED, (self._rig, after_session, kind.value, kind is not JobKind.GAP))

    def is_comparison_queued(self, model_id: int, live_since: int) -> bool:
        """Return True if a model's comparison was ever queued while the live model was that of change `live_since`."""
        sql = "SELECT 1 FROM jobs WHERE kind = 'comparison' AND model_id = ? AND live_since = ? LIMIT 1"
        return bool(self._store.rows(sql, (model_id, live_since)))

    def is_superseded(self, job_id: int) -> bool:
        """Return True if an operator has accepted a check session, or rejected a used one, since a job was queued."""
        sql = f"""SELECT 1 FROM calibration_sessions
            WHERE rig = ? AND accepted_after_job IS NOT NULL AND accepted_after_job >= ? AND kind = '{CHECK}' LIMIT 1"""
        return bool(self._store.rows(sql, (self._rig, job_id)))

    def comparison_of(self, model: ModelRow) -> int | None:
        """Return the unfinished job that compares a model on held-out sessions; None if there is none.

        A comparison that names no model compares the model of the job on which it depends, or else the newest model.
        """
        sql = """SELECT job.id FROM jobs AS job LEFT JOIN jobs AS made ON made.id = job.depends_on
            WHERE job.kind = 'comparison' AND job.state IN ('queued', 'running', 'interrupted') AND coalesce(
                job.model_id = ?, json_extract(made.result_json, '$.model') = ?, job.depends_on IS NULL)
            ORDER BY job.id LIMIT 1"""
        found = self._store.rows(sql, (model.id, str(model.path)))
        return int(found[0]["id"]) if found else None

    def comparison_after(self, model: ModelRow) -> tuple[int, int] | None:
        """Return the unfinished job that compares the model of a later stage, and the job that makes it; or None.

        The model of the later stage is made from this model and from the same sessions.
        """
        sql = """SELECT job.id, job.depends_on FROM jobs AS job JOIN jobs AS later ON later.id = job.depends_on
            JOIN jobs AS made ON made.id = later.depends_on
            WHERE job.kind = 'comparison' AND job.state IN ('queued', 'running', 'interrupted')
                AND json_extract(made.result_json, '$.model') = ?
            ORDER BY job.id LIMIT 1"""
        found = self._store.rows(sql, (str(model.path),))
        return (int(found[0]["id"]), int(found[0]["depends_on"])) if found else None

    # ---- one job -----------------------------------------------------------------------------------------------------

    def get(self, job_id: object) -> dict[str, Any]:
        """Return a job's row.

        Raises:
            NotInStoreError: there is no job of that number.
        """
        found = type(job_id) is int and self._store.rows("SELECT * FROM jobs WHERE id = ?", (job_id,))
        if not found:
            raise NotInStoreError(f"there is no job {job_id!r:.80}; `rigcal jobs list` shows them")
        return found[0]

    def result(self, job_id: int) -> dict[str, Any]:
        """Return the result of a job; empty before it has one."""
        return _result(self.get(job_id))

    def newest(self, kind: JobKind, state: str) -> dict[str, Any] | None:
        """Return the newest job of a kind in a state, with its `result`; None if there is none."""
        found = self._store.rows(_NEWEST, (kind, state, self._rig))
        return found[0] | {"result": _result(found[0])} if found else None

    def latencies(self) -> dict[str, dict[str, Any]]:
        """Return session -> latency of its fixes relative to the joints, from the newest report; empty without one."""
        report = self.newest(JobKind.REPORT, "done")
        return {} if report is None else dict(report["result"].get("latency", {}))

    def has_done(self, kind: JobKind) -> bool:
        """Return True if a job of a kind was ever done."""
        return bool(self._store.rows(_NEWEST, (kind, "done", self._rig)))

    def sessions_of(self, job_id: int, through_session_id: str) -> list[dict[str, Any]]:
        """Return number, id and kind of the sessions that a job works on, fixed when it was queued; oldest first."""
        return self._store.rows(_WORKED_ON, (self._rig, job_id, through_session_id))

    def chain(self, job_id: int) -> list[dict[str, Any]]:
        """Return id and state of a job and of all jobs that wait for it, in order."""
        return self._store.rows(_CHAIN, (job_id,))

    # ---- lists -------------------------------------------------------------------------------------------------------

    def all(self, clock: Clock) -> list[dict[str, Any]]:
        """Return all jobs with their results, newest last, and their durations so far, in real time.

        Uses a separate connection, so that the writing connection does not wait.
        """
        with self._store.reader() as reader:
            rows = reader.rows(f"SELECT {_SHOWN}, result_json FROM jobs ORDER BY id")
            return [_shown(row, clock) for row in rows]

    def unfinished(self) -> list[dict[str, Any]]:
        """Return the jobs that are running, waiting or interrupted, without results, newest last."""
        sql = f"SELECT {_SHOWN} FROM jobs WHERE state IN ('queued', 'running', 'interrupted') ORDER BY id"
        return self._store.rows(sql)

    def counts(self) -> list[dict[str, Any]]:
        """Return the `count` of jobs by kind and state."""
        return self._store.rows("SELECT kind, state, count(*) AS count FROM jobs GROUP BY kind, state")

    def running(self) -> list[dict[str, Any]]:
        """Return id and host_boot of the jobs that are marked as running."""
        return self._store.rows("SELECT id, host_boot FROM jobs WHERE state = 'running'")

    def of_session(self, session_id: str, clock: Clock) -> list[dict[str, Any]]:
        """Return the jobs triggered by a session, in the form of `all`."""
        sql = f"SELECT {_SHOWN}, result_json FROM jobs WHERE session_id = ? ORDER BY id"
        return [_shown(row, clock) for row in self._store.rows(sql, (session_id,))]

    def has_of_session(self, session_id: str) -> bool:
        """Return True if a session has triggered a job."""
        return bool(self._store.rows("SELECT 1 FROM jobs WHERE session_id = ? LIMIT 1", (session_id,)))

    def first_on(self, session_id: str, *kinds: JobKind) -> dict[str, Any] | None:
        """Return id and session_id of the first job of some kinds that works on a session; None if there is none."""
        sql = _FIRST_ON.format(kinds=marks(kinds))
        return next(iter(self._store.rows(sql, (session_id, *kinds))), None)

    def failed(self) -> list[FailedJob]:
        """Return the newest failed job of each kind, unless a later job of the kind is done."""
        return [
            FailedJob(row["id"], row["kind"], row["error"] or "")
            for row in self._store.rows(_FAILED, (self._rig,))
            if not self._store.rows(_DONE_LATER, (row["id"], row["kind"], self._rig))
        ]

    def newest_id(self) -> int:
        """Return the number of the newest job of any rig; 0 before the first."""
        return self._store.number("SELECT coalesce(max(id), 0) FROM jobs", ()) or 0

    # ---- changes -----------------------------------------------------------------------------------------------------

    def add(self, created: Stamp, **columns: object) -> int:
        """Add a queued job, and return its number."""
        return self._store.insert("jobs", {**columns, "state": "queued", **self._store.instant(created, "created_")})

    def change(self, job_id: int, **columns: object) -> None:
        """Change columns of a job."""
        self._store.update("jobs", {"id": job_id}, columns)

    def offer_again(self, job_id: int) -> bool:
        """Queue an interrupted job again; return False if it is no longer interrupted."""
        return bool(self._store.update("jobs", {"id": job_id, "state": "interrupted"}, {"state": "queued"}))


def _shown(row: dict[str, Any], clock: Clock) -> dict[str, Any]:
    took_s = row["duration_s"]
    if row["state"] == "running":
        took_s = max(0.0, (clock.now().utc_ns - row["started_utc_ns"]) / NS_PER_S)
    if took_s is not None:
        took_s = round(clock.real_seconds(took_s), 1)
    return row | {"duration_s": took_s, "result": json.loads(row.pop("result_json") or "null")}


def _result(row: Mapping[str, Any]) -> dict[str, Any]:
    return dict(json.loads(row["result_json"] or "{}"))
