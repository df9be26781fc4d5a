"""The table of jobs: what scheduling, running and showing them asks of it."""

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

# Scheduling runs twice a second beside acquisition, for months: CROSS JOIN and NOT INDEXED keep SQLite's planner from
# starting with all of a rig's sessions.
# The newest session of each kind and state that calibration may use; the index holds all that it asks for.
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
# Walks back from the newest session to one that a job of this kind was queued through, or that no longer matters. A job
# that was queued before an operator accepted a session does not work on that one, and covers nothing any more.
_COVERED = f"""SELECT session.rowid AS number FROM calibration_sessions AS session NOT INDEXED
    WHERE session.rig = ?1 AND session.rowid > ?2
        AND EXISTS (SELECT 1 FROM jobs WHERE jobs.through_session_id = session.id AND jobs.kind = ?3 AND jobs.id >
            (SELECT coalesce(max(accepted_after_job), 0) FROM calibration_sessions
                WHERE rig = ?1 AND accepted_after_job IS NOT NULL AND (kind = '{CHECK}') = ?4))
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
# The first job that works on a session, one of some kinds: it was queued after the session ended, or was accepted.
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
    """Kind of a job: the work that it does."""

    GAP = "gap"
    RESIDUAL = "residual"
    REPORT = "report"
    COMPARISON = "comparison"
    DRIFT = "drift"


@dataclass(frozen=True)
class SessionFacts:
    """A calibration session, as far as scheduling needs it.

    Attributes:
        id: of the session.
        number: grows from one session to the next. One is open at a time, so they end in the order they start.
        kind: single_joint, multi_joint, static_poses or check.
        state: open, closed or aborted.
        ended: when it was closed, None while open.
    """

    id: str
    number: int
    kind: str
    state: str
    ended: Stamp | None


@dataclass(frozen=True)
class JobFacts:
    """A job that has not ended for good, as far as scheduling needs it.

    Attributes:
        id: of the job.
        kind: see JobKind.
        session_id: the session that triggered it.
        state: queued, running or interrupted.
        attempts: how often it was started.
        is_ready: whether the job that it depends on, if any, is done.
        ended: when it was interrupted last.
        interruptions: how often something interrupted it that was no attempt: the computer's own end, a full disk.
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
    """The newest failed job of its kind, with no later one done.

    Attributes:
        id, kind: of the job.
        error: why it failed.
    """

    id: int
    kind: str
    error: str


class JobTable:
    """The jobs of one rig.

    Args:
        store: the database.
        rig_name: whose sessions are worked on.
    """

    def __init__(self, store: Connection, rig_name: str) -> None:
        self._store, self._rig = store, rig_name

    # ---- for scheduling ----------------------------------------------------------------------------------------------

    def newest_sessions(self) -> list[SessionFacts]:
        """The newest session of each kind and state that calibration may use, in the order they were started."""
        rows = self._store.rows(_SESSIONS, (self._rig,))
        return [
            SessionFacts(row["id"], row["number"], row["kind"], row["state"], self._store.stamp_or_none(row, "ended_"))
            for row in rows
        ]

    def pending(self) -> list[JobFacts]:
        """Jobs that have not ended for good, in the order they were created."""
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
        """Number of the newest session that the newest job of a kind works on; None where there is none.

        Args:
            kind: of the job.
            after_session: sessions up to this number do not matter.
        """
        return self._store.number(_COVERED, (self._rig, after_session, kind.value, kind is not JobKind.GAP))

    def is_comparison_queued(self, model_id: int, live_since: int) -> bool:
        """True if a model was ever to be compared with the one that went live by that change."""
        sql = "SELECT 1 FROM jobs WHERE kind = 'comparison' AND model_id = ? AND live_since = ? LIMIT 1"
        return bool(self._store.rows(sql, (model_id, live_since)))

    def comparison_of(self, model: ModelRow) -> int | None:
        """Return the job that is yet to compare a model on held-out sessions; None without one.

        One that names no model compares that of the job before it, or else the newest one.
        """
        sql = """SELECT job.id FROM jobs AS job LEFT JOIN jobs AS made ON made.id = job.depends_on
            WHERE job.kind = 'comparison' AND job.state IN ('queued', 'running', 'interrupted') AND coalesce(
                job.model_id = ?, json_extract(made.result_json, '$.model') = ?, job.depends_on IS NULL)
            ORDER BY job.id LIMIT 1"""
        found = self._store.rows(sql, (model.id, str(model.path)))
        return int(found[0]["id"]) if found else None

    def comparison_after(self, model: ModelRow) -> tuple[int, int] | None:
        """Return the job that is yet to compare the model of a later stage, and the job that makes that; or None.

        The model of a later stage is made from this one and of the same sessions.
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
        """A job's row.

        Raises:
            NotInStoreError: there is none of that number.
        """
        found = type(job_id) is int and self._store.rows("SELECT * FROM jobs WHERE id = ?", (job_id,))
        if not found:
            raise NotInStoreError(f"there is no job {job_id!r:.80}; `rigcal jobs list` shows them")
        return found[0]

    def result(self, job_id: int) -> dict[str, Any]:
        """Result of a job; empty before it has one."""
        return _result(self.get(job_id))

    def newest(self, kind: JobKind, state: str) -> dict[str, Any] | None:
        """The newest job of a kind in a state, with its `result`; None where there is none."""
        found = self._store.rows(_NEWEST, (kind, state, self._rig))
        return found[0] | {"result": _result(found[0])} if found else None

    def latencies(self) -> dict[str, dict[str, Any]]:
        """Session -> latency of its fixes against the joints, of the newest report; empty before one."""
        report = self.newest(JobKind.REPORT, "done")
        return {} if report is None else dict(report["result"].get("latency", {}))

    def has_done(self, kind: JobKind) -> bool:
        """True if a job of a kind was ever done."""
        return bool(self._store.rows(_NEWEST, (kind, "done", self._rig)))

    def sessions_of(self, job_id: int, through_session_id: str) -> list[dict[str, Any]]:
        """Number, id and kind of the sessions that a job works on, settled when it was queued; oldest first."""
        return self._store.rows(_WORKED_ON, (self._rig, job_id, through_session_id))

    def chain(self, job_id: int) -> list[dict[str, Any]]:
        """Id and state of a job and, in order, of all that wait for it."""
        return self._store.rows(_CHAIN, (job_id,))

    # ---- lists -------------------------------------------------------------------------------------------------------

    def all(self, clock: Clock) -> list[dict[str, Any]]:
        """All jobs with their results, newest last, and how long each took or runs already, in real time.

        Read beside the writing connection, which must not wait.
        """
        with self._store.reader() as reader:
            rows = reader.rows(f"SELECT {_SHOWN}, result_json FROM jobs ORDER BY id")
            return [_shown(row, clock) for row in rows]

    def unfinished(self) -> list[dict[str, Any]]:
        """Jobs that run, wait, or will be offered again, without results, newest last."""
        sql = f"SELECT {_SHOWN} FROM jobs WHERE state IN ('queued', 'running', 'interrupted') ORDER BY id"
        return self._store.rows(sql)

    def counts(self) -> list[dict[str, Any]]:
        """Kind, state and `count` of all jobs."""
        return self._store.rows("SELECT kind, state, count(*) AS count FROM jobs GROUP BY kind, state")

    def running(self) -> list[dict[str, Any]]:
        """Id and host_boot of the jobs that are marked as running."""
        return self._store.rows("SELECT id, host_boot FROM jobs WHERE state = 'running'")

    def of_session(self, session_id: str, clock: Clock) -> list[dict[str, Any]]:
        """The jobs that a session has triggered, as `all` has them."""
        sql = f"SELECT {_SHOWN}, result_json FROM jobs WHERE session_id = ? ORDER BY id"
        return [_shown(row, clock) for row in self._store.rows(sql, (session_id,))]

    def has_of_session(self, session_id: str) -> bool:
        """True if a session has triggered a job."""
        return bool(self._store.rows("SELECT 1 FROM jobs WHERE session_id = ? LIMIT 1", (session_id,)))

    def first_on(self, session_id: str, *kinds: JobKind) -> dict[str, Any] | None:
        """Id and session_id of the first job of some kinds that works on a session; None where there is none."""
        sql = _FIRST_ON.format(kinds=marks(kinds))
        return next(iter(self._store.rows(sql, (session_id, *kinds))), None)

    def failed(self) -> list[FailedJob]:
        """The newest failed job of each kind, where no later one of the kind is done."""
        return [
            FailedJob(row["id"], row["kind"], row["error"] or "")
            for row in self._store.rows(_FAILED, (self._rig,))
            if not self._store.rows(_DONE_LATER, (row["id"], row["kind"], self._rig))
        ]

    def newest_id(self) -> int:
        """Number of the newest job of any rig; 0 before the first."""
        return self._store.number("SELECT coalesce(max(id), 0) FROM jobs", ()) or 0

    # ---- changes -----------------------------------------------------------------------------------------------------

    def add(self, created: Stamp, **columns: object) -> int:
        """Add a queued job; its number."""
        return self._store.insert("jobs", {**columns, "state": "queued", **self._store.instant(created, "created_")})

    def change(self, job_id: int, **columns: object) -> None:
        """Change columns of a job."""
        self._store.update("jobs", {"id": job_id}, columns)

    def offer_again(self, job_id: int) -> bool:
        """Queue an interrupted job again; False if it is interrupted no more."""
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
