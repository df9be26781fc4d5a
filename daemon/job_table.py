"""The store's table of jobs: what is in it, and every way in which a job changes its state.

Each change reads and writes in one transaction, and transactions take turns: what an operator says and what a job's
process does meet here, and the second of the two finds what the first one did.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from daemon.config import Config
from daemon.control import REFUSED, CommandError
from daemon.drift_table import DriftTable, LiveRun
from daemon.model_table import ModelRow, ModelTable, trained_on
from daemon.order import Order, Outcome, Progress
from daemon.scheduler import CHECK, CHECKS, DueChain, JobFacts, JobKind, SessionFacts, State
from daemon.store.store import Store
from drivers.clock import Clock

CANCELLED = Outcome("cancelled", "cancelled by the operator")
STOPPED = Outcome("interrupted", "the daemon was stopped")
CANCELLABLE = ("queued", "running", "interrupted")
RETRIABLE = ("failed", "cancelled", "interrupted")
SHOWN = "id, kind, session_id, state, progress, message, attempts, error"

# These run twice a second beside acquisition, for months: CROSS JOIN and NOT INDEXED keep SQLite's planner from
# starting with all of a rig's sessions.
# The newest session of each kind and state that calibration may use; the index holds all that it asks for.
_SESSIONS = """SELECT id, rowid AS number, kind, state, ended_utc_ns, ended_monotonic_ns, ended_boot_id
    FROM calibration_sessions WHERE rowid IN
        (SELECT max(rowid) FROM calibration_sessions
            WHERE rig = ? AND state IN ('open', 'closed') AND excluded IS NULL GROUP BY state, kind)
    ORDER BY rowid"""
_JOBS = """SELECT job.id, job.kind, job.session_id, job.state, job.attempts,
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
_NEWEST_MODEL = """SELECT job.result_json FROM jobs AS job
    JOIN calibration_sessions AS session ON session.id = job.session_id
    WHERE job.state = 'done' AND job.kind = 'residual' AND session.rig = ? ORDER BY job.id DESC LIMIT 1"""
_WORKED_ON = """SELECT rowid AS number, id, kind FROM calibration_sessions WHERE rig = ? AND state = 'closed'
        AND excluded IS NULL AND coalesce(accepted_after_job, 0) < ?
        AND rowid <= (SELECT rowid FROM calibration_sessions WHERE id = ?)
    ORDER BY rowid"""
_CHAIN = """WITH RECURSIVE chain(id) AS (VALUES (?) UNION SELECT jobs.id FROM jobs JOIN chain ON depends_on = chain.id)
    SELECT id, state FROM chain JOIN jobs USING (id) ORDER BY id"""


class JobTable:
    """The jobs of one rig.

    Args:
        store: where they are.
        rig_name: whose sessions are worked on.
        clock: for when what happened.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock) -> None:
        self._store = store
        self._rig = rig_name
        self._clock = clock
        self._models = ModelTable(store, rig_name, clock)
        self._drift = DriftTable(store, rig_name, clock)

    # ---- what is there -----------------------------------------------------------------------------------------------

    def state(self) -> State:
        """What scheduling needs to know."""
        run = self._drift.run()
        back_to = {JobKind.GAP: 0, JobKind.REPORT: 0} | ({JobKind.DRIFT: run.after_session} if run else {})
        covered = {
            kind: rows[0]["number"]
            for kind, after in back_to.items()
            if (rows := self._store.rows(_COVERED, (self._rig, after, kind, kind is not JobKind.GAP)))
        }
        return State(
            [
                SessionFacts(row["id"], row["number"], row["kind"], row["state"], self._store.stamp(row, "ended_"))
                for row in self._store.rows(_SESSIONS, (self._rig,))
            ],
            [
                JobFacts(
                    row["id"],
                    JobKind(row["kind"]),
                    row["session_id"],
                    row["state"],
                    row["attempts"],
                    bool(row["is_ready"]),
                    self._store.stamp(row, "ended_"),
                    row["interruptions"],
                )
                for row in self._store.rows(_JOBS, (self._rig,))
            ],
            covered,
            has_model=bool(self._store.rows(_NEWEST_MODEL, (self._rig,))),
            live_from=run.after_session if run else None,
            drifted=self._drift.drifted(run) if run else None,
            stale_candidate=self._stale_candidate(run) if run else None,
        )

    def _stale_candidate(self, run: LiveRun) -> int | None:
        """See `State.stale_candidate`; one comparison for each model that goes live, as what fails must not loop."""
        candidate = self._models.waiting()
        if candidate is None or candidate.comparison is None or candidate.comparison["live"] == run.model_id:
            return None
        queued = self._store.rows(
            "SELECT 1 FROM jobs WHERE kind = 'comparison' AND model_id = ? AND live_since = ? LIMIT 1",
            (candidate.id, run.since),
        )
        return None if queued else candidate.id

    def all(self) -> list[dict[str, Any]]:
        """All jobs with their results, newest last. Read beside the writing connection, which must not wait."""
        with self._store.reader() as reader:
            rows = list(reader.rows(f"SELECT {SHOWN}, result_json FROM jobs ORDER BY id"))
        return [row | {"result": json.loads(row.pop("result_json") or "null")} for row in rows]

    def unfinished(self) -> list[dict[str, Any]]:
        """Jobs that run, wait, or will be offered again, without results, newest last."""
        return self._store.rows(
            f"SELECT {SHOWN} FROM jobs WHERE state IN ('queued', 'running', 'interrupted') ORDER BY id"
        )

    def order(self, job: JobFacts, config: Config) -> Order:
        """What a job's process is asked to do: the sessions were settled when the job was queued."""
        (row,) = self._store.rows("SELECT depends_on, through_session_id, model_id FROM jobs WHERE id = ?", (job.id,))
        sessions = self._store.rows(_WORKED_ON, (self._rig, job.id, row["through_session_id"]))
        training = tuple(s["id"] for s in sessions if s["kind"] != CHECK)
        checks = tuple(s["id"] for s in sessions if s["kind"] == CHECK)
        if row["model_id"] is not None:
            return self._comparison(job, config, self._models.get(row["model_id"]), checks)
        if job.kind is JobKind.GAP:
            # Drifted checks trigger it to find the reason in them; after a training session they are held out.
            if job.session_id in checks:
                return self._order(job, config, tuple(s["id"] for s in sessions))
            return self._order(job, config, training, held_out_ids=checks)
        if job.kind is JobKind.DRIFT:
            return self._drift_order(job, config, [(s["number"], s["id"]) for s in sessions if s["kind"] == CHECK])
        if row["depends_on"] is None:
            before = self._store.rows(_NEWEST_MODEL, (self._rig,))
        else:
            before = self._store.rows("SELECT result_json FROM jobs WHERE id = ?", (row["depends_on"],))
        result = json.loads(before[0]["result_json"]) if before else {}
        if job.kind is JobKind.COMPARISON:
            return self._comparison(job, config, self._models.at(result["model"]), checks)
        train_ids = tuple(result.get("sessions", training))
        return self._order(
            job,
            config,
            tuple(name for name in checks if name not in train_ids) if job.kind is JobKind.REPORT else training,
            model=result.get("model"),
            model_sha256=result.get("manifest_sha256"),
            train_ids=train_ids,
        )

    def _comparison(self, job: JobFacts, config: Config, model: ModelRow, checks: tuple[str, ...]) -> Order:
        """A model beside the live one, on the check sessions that neither was trained on."""
        live = self._models.live()
        if live is not None and live.id == model.id:
            live = None  # it is live already, and only the nominal model is left to compare it with
        seen = trained_on([model, live])
        return self._order(
            job,
            config,
            tuple(name for name in checks if name not in seen),
            model=str(model.path),
            model_sha256=model.manifest_sha256,
            train_ids=model.sessions,
            live=live,
        )

    def _drift_order(self, job: JobFacts, config: Config, checks: list[tuple[int, str]]) -> Order:
        """The live model on the check sessions since it went live that it was not held against yet."""
        run = self._drift.run()
        if run is None:
            return self._order(job, config, ())
        live = self._models.get(run.model_id)
        return self._order(job, config, self._drift.unseen(run, checks, live.sessions), live=live, live_since=run.since)

    def _order(
        self,
        job: JobFacts,
        config: Config,
        session_ids: tuple[str, ...],
        *,
        model: str | None = None,
        model_sha256: str | None = None,
        train_ids: tuple[str, ...] = (),
        live: ModelRow | None = None,
        **more: Any,
    ) -> Order:
        file = self._store.files.database
        return Order(
            kind=job.kind.value,
            job_id=job.id,
            store=str(config.store_path),
            models_directory=str(config.models_directory),
            session_ids=session_ids,
            model=model,
            model_sha256=model_sha256,
            train_ids=train_ids,
            seed=config.jobs.seed,
            live_model=str(live.path) if live else None,
            live_sha256=live.manifest_sha256 if live else None,
            live_id=live.id if live else None,
            store_file=(file.device, file.inode) if file else None,
            **more,
        )

    # ---- what the runner does ----------------------------------------------------------------------------------------

    def queue(self, due: DueChain) -> None:
        """Queue new jobs: training in its order, and what checks a model after the job that makes it, and nothing else.

        A report that fails thus keeps no comparison from running, nor the other way round.
        """
        with self._store.transaction():
            made_by: int | None = None
            for kind in due.kinds:
                job_id = self._add(kind, due.session_id, due.through_id, depends_on=made_by)
                if kind not in CHECKS:
                    made_by = job_id

    def offer_again(self, job_id: int) -> bool:
        """Queue an interrupted job again; False if it is interrupted no more."""
        return bool(self._store.update("jobs", {"id": job_id, "state": "interrupted"}, {"state": "queued"}))

    def begin(self, job: JobFacts, time_limit_s: float, host_boot: str | None = None) -> bool:
        """A queued job runs from now on, and shows nothing of earlier runs; False if it is queued no more.

        Args:
            job: which.
            time_limit_s: how long it may run.
            host_boot: the computer's boot; None where it is unknown.
        """
        with self._store.transaction():
            if self._job(job.id)["state"] != "queued":
                return False
            self._set(
                job.id,
                state="running",
                attempts=job.attempts + 1,
                time_limit_s=time_limit_s,
                host_boot=host_boot,
                progress=0.0,
                message="",
                error=None,
                result_json=None,
                **self._store.instant(self._clock.now(), "started_"),
                ended_utc_ns=None,
                ended_monotonic_ns=None,
                ended_boot_id=None,
            )
            return True

    def note_process(self, job_id: int, pid: int) -> None:
        """The process that a running job runs in."""
        self._set(job_id, pid=pid)

    def note_progress(self, job_id: int, progress: Progress) -> None:
        """How far a running job is."""
        self._set(job_id, progress=progress.share, message=progress.message)

    def is_cancelled(self, job_id: int) -> bool:
        """Whether the operator wants a running job to end."""
        return _is_cancelled(self._job(job_id))

    def end(self, job_id: int, outcome: Outcome, *, is_innocent: bool = False) -> Outcome:
        """A job has ended; with one that failed or was cancelled end those that wait for it.

        An orderly stop of the daemon is no fault of the job's and no attempt.

        Args:
            job_id: which.
            outcome: how.
            is_innocent: what interrupted it was not the job's doing: it is counted as that, and as no attempt.

        Returns:
            how it ended in the end: what the operator said goes before what the process said.
        """
        with self._store.transaction():
            job = self._job(job_id)
            if _is_cancelled(job):
                outcome, is_innocent = CANCELLED, False
            ended = self._store.instant(self._clock.now(), "ended_")
            is_done = outcome.state == "done"
            self._set(
                job_id,
                state=outcome.state,
                error=outcome.error,
                attempts=job["attempts"] - 1 if outcome == STOPPED or is_innocent else job["attempts"],
                interruptions=job["interruptions"] + is_innocent,
                result_json=outcome.result,
                progress=1.0 if is_done else 0.0,
                message="",  # what it was doing is no news any more
                pid=None,
                **ended,
            )
            if outcome.result is not None and "manifest_sha256" in outcome.result:
                self._models.add(job_id, outcome.result)
            if outcome.result is not None and "comparison" in outcome.result:
                self._models.note_comparison(outcome.result["model"], outcome.result["comparison"])
            if outcome.result is not None and "drift" in outcome.result:
                self._drift.note(outcome.result["drift"])
            if outcome.state in {"failed", "cancelled"}:
                for waiting in self._chain(job_id)[1:]:
                    if waiting["state"] in {"queued", "interrupted"}:
                        why = "has failed" if outcome.state == "failed" else "was cancelled"
                        error = f"it needs job {job_id}, which {why}"
                        self._set(waiting["id"], state="cancelled", error=error, **ended)
            return outcome

    def interrupt_running(self, why: str, *, is_innocent: bool = False) -> None:
        """Jobs that the store takes for running, and that nobody runs, did not end: the scheduler offers them again.

        Args:
            why: they did not.
            is_innocent: as for `end`.
        """
        for row in self._store.rows("SELECT id FROM jobs WHERE state = 'running'"):
            self.end(row["id"], Outcome("interrupted", why), is_innocent=is_innocent)

    def interrupt_left_over(self, host_boot: str) -> None:
        """Interrupt the jobs that the daemon before this one left running.

        One that a stop had no time to write down was stopped in order. One of another boot was cut off with the
        computer. Of the rest the daemon was killed, which may have been the job's doing, and is an attempt.

        Args:
            host_boot: the computer's boot.
        """
        for row in self._store.rows("SELECT id, host_boot FROM jobs WHERE state = 'running'"):
            if row["host_boot"] not in (host_boot, None):
                cut = Outcome("interrupted", "the computer was switched off or restarted while it ran")
                self.end(row["id"], cut, is_innocent=True)
            elif self._store.ended_in_order:
                self.end(row["id"], STOPPED)
            else:
                self.end(row["id"], Outcome("interrupted", "the daemon ended while it ran"))

    # ---- what the operator does --------------------------------------------------------------------------------------

    def cancel(self, job_id: object) -> str:
        """Cancel a job that has not ended.

        Returns:
            a sentence for the operator.

        Raises:
            CommandError: there is none, or it has ended.
        """
        with self._store.transaction():
            job = self._job(job_id)
            if job["state"] not in CANCELLABLE:
                raise CommandError(f"job {job['id']} is {job['state']}; only one that has not ended can be cancelled")
            if job["state"] == "running":
                self._set(job["id"], error=CANCELLED.error)  # whoever runs it, now or after a restart, finds it there
                return f"job {job['id']} ({job['kind']}) is being cancelled"
            self.end(job["id"], CANCELLED)
            return f"job {job['id']} ({job['kind']}) is cancelled"

    def retry(self, job_id: object) -> str:
        """Queue a job that did not end well again, and with it those that waited for it; their attempts count anew.

        Returns:
            a sentence for the operator.

        Raises:
            CommandError: there is none, it has not ended or ended well, or the one before it did not end well.
        """
        with self._store.transaction():
            job = self._job(job_id)
            if job["state"] not in RETRIABLE:
                raise CommandError(f"job {job['id']} is {job['state']}; only one that did not end well can be retried")
            if job["depends_on"] is not None:
                before = self._job(job["depends_on"])
                if before["state"] in RETRIABLE:
                    raise CommandError(
                        f"job {job['id']} waits for job {before['id']}, which is {before['state']}; retry that one: "
                        "those that wait for it follow"
                    )
            for waiting in self._chain(job["id"]):
                self._set(
                    waiting["id"], state="queued", progress=0.0, message="", error=None, attempts=0, interruptions=0
                )
            return f"job {job['id']} ({job['kind']}) is queued again"

    def compare(self, model: ModelRow) -> str:
        """Queue a comparison of a model with the live one, on all check sessions that are closed and used.

        Returns:
            a sentence for the operator.

        Raises:
            CommandError: there is none.
        """
        closed = self._store.rows(
            "SELECT id, kind FROM calibration_sessions WHERE rig = ? AND state = 'closed' AND excluded IS NULL "
            "ORDER BY rowid",
            (self._rig,),
        )
        checks = [session["id"] for session in closed if session["kind"] == CHECK]
        if not checks:
            raise CommandError(
                "no check session is closed and used, so nothing is held out to compare on; hold one with `rigcal "
                "session start --kind check`",
                REFUSED,
            )
        run = self._drift.run()
        job_id = self._add(
            JobKind.COMPARISON, checks[-1], closed[-1]["id"], model_id=model.id, live_since=run.since if run else None
        )
        return f"job {job_id} will compare model {model.id} with the live one"

    def compare_again(self, model_id: int) -> str:
        """Queue a comparison of the model of that number, as `compare` does."""
        return self.compare(self._models.get(model_id))

    # ---- parts -------------------------------------------------------------------------------------------------------

    def _add(
        self,
        kind: JobKind,
        session_id: str,
        through_id: str,
        *,
        depends_on: int | None = None,
        model_id: int | None = None,
        live_since: int | None = None,
    ) -> int:
        """Queue a job; its number."""
        row = {
            "kind": kind.value,
            "session_id": session_id,
            "through_session_id": through_id,
            "state": "queued",
            "depends_on": depends_on,
            "model_id": model_id,
            "live_since": live_since,
            **self._store.instant(self._clock.now(), "created_"),
        }
        return self._store.insert("jobs", row)

    def _job(self, job_id: object) -> dict[str, Any]:
        found = type(job_id) is int and self._store.rows(
            "SELECT id, kind, state, attempts, interruptions, depends_on, error FROM jobs WHERE id = ?", (job_id,)
        )
        if not found:
            raise CommandError(f"there is no job {job_id!r:.80}; `rigcal jobs list` shows them")
        return found[0]

    def _chain(self, job_id: int) -> list[dict[str, Any]]:
        """Id and state of a job and, in order, of all that wait for it."""
        return self._store.rows(_CHAIN, (job_id,))

    def _set(self, job_id: int, **columns: object) -> None:
        self._store.update("jobs", {"id": job_id}, columns)


def _is_cancelled(job: Mapping[str, Any]) -> bool:
    """True if the operator wants a running job to end; one that runs has no other error."""
    return (job["state"], job["error"]) == ("running", CANCELLED.error)
