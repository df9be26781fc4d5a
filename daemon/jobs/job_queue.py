"""All state changes of jobs, and the orders for their processes.

Each change reads and writes in one transaction, and transactions are serialized: if an operator's command and the
outcome of a job's process coincide, the second of them sees the effect of the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from daemon.commands import CHECK, REFUSED, CommandError
from daemon.config.config import Config
from daemon.jobs.order import Order, Outcome, ProgressMessage
from daemon.jobs.scheduler import CHECKS, DueChain, State
from daemon.models.drift import note_drift, unseen_checks
from daemon.store.queries.guides import GuideTable
from daemon.store.queries.jobs import JobFacts, JobKind, JobTable
from daemon.store.queries.models import LiveRun, ModelRow, ModelTable, trained_on
from daemon.store.queries.sessions import SessionTable
from daemon.store.store import Store
from drivers.clock import Clock

CANCELLED = Outcome("cancelled", "cancelled by the operator")
STOPPED = Outcome("interrupted", "the daemon was stopped")
CANCELLABLE = ("queued", "running", "interrupted")
RETRIABLE = ("failed", "cancelled", "interrupted")


class JobQueue:
    """The jobs of one rig.

    Args:
        store: the database.
        rig_name: rig whose sessions are used.
        clock: for the times of changes.

    Attributes:
        table: the jobs in the store.
    """

    def __init__(self, store: Store, rig_name: str, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self.table = JobTable(store, rig_name)
        self._sessions = SessionTable(store, rig_name)
        self._models = ModelTable(store, rig_name, clock)
        self._guides = GuideTable(store, rig_name)

    def state(self) -> State:
        """Return the facts that scheduling depends on."""
        run = self._models.live_run()
        back_to = {JobKind.GAP: 0, JobKind.REPORT: 0} | ({JobKind.DRIFT: run.after_session} if run else {})
        covered = {kind: self.table.covered(kind, after) for kind, after in back_to.items()}
        return State(
            self.table.newest_sessions(),
            self.table.pending(),
            {kind: number for kind, number in covered.items() if number is not None},
            has_model=self.table.has_done(JobKind.GAP),
            live_from=run.after_session if run else None,
            drifted=self._models.drifted(run) if run else None,
            stale_candidate=self._stale_candidate(run),
            has_guide=self._guides.is_open(),
        )

    def _stale_candidate(self, run: LiveRun | None) -> int | None:
        """See `State.stale_candidate`; one comparison per change of live model, so that a failing one does not loop."""
        candidate = self._models.waiting()
        if candidate is None or candidate.comparison is None:
            return None
        if candidate.comparison["live"] == (run.model_id if run else None):
            return None
        since = self._live_since(run)
        is_queued = since is None or self.table.is_comparison_queued(candidate.id, since)
        return None if is_queued else candidate.id

    def _live_since(self, run: LiveRun | None) -> int | None:
        """Return the number of the change by which the live model went live, or else since which none is live."""
        return run.since if run else self._models.newest_retirement()

    # ---- orders ------------------------------------------------------------------------------------------------------

    def order(self, job: JobFacts, config: Config) -> Order:
        """Return the order for a job's process; its sessions were fixed when the job was queued."""
        row = self.table.get(job.id)
        sessions = self.table.sessions_of(job.id, row["through_session_id"])
        training = tuple(s["id"] for s in sessions if s["kind"] != CHECK)
        checks = tuple(s["id"] for s in sessions if s["kind"] == CHECK)
        if job.kind is JobKind.GAP:
            # Triggered by a drifted check, the job searches the checks too. After a training session they are held out.
            if job.session_id in checks:
                return self._order(job, config, tuple(s["id"] for s in sessions))
            return self._order(job, config, training, held_out_ids=checks)
        if job.kind is JobKind.DRIFT:
            return self._drift_order(job, config, [(s["number"], s["id"]) for s in sessions if s["kind"] == CHECK])
        model = self._model_of(row)
        if model is None:
            return self._order(job, config, ())
        if job.kind is JobKind.COMPARISON:
            return self._comparison(job, config, model, checks)
        return self._order(
            job,
            config,
            tuple(name for name in checks if name not in model.sessions) if job.kind is JobKind.REPORT else training,
            model=str(model.path),
            model_sha256=model.manifest_sha256,
            train_ids=model.sessions,
        )

    def _model_of(self, row: Mapping[str, Any]) -> ModelRow | None:
        """Return the model that a job works on: the one it names, the one of the job it depends on, or the newest.

        Args:
            row: the job.

        Returns:
            None for a job that identifies a model or checks the live one for drift.
        """
        if row["model_id"] is not None:
            return self._models.get(row["model_id"])
        if row["depends_on"] is not None:
            return self._models.at(self.table.result(row["depends_on"])["model"])
        return None if row["kind"] in (JobKind.GAP, JobKind.DRIFT) else self._models.newest()

    def _comparison(self, job: JobFacts, config: Config, model: ModelRow, checks: tuple[str, ...]) -> Order:
        """Order a comparison of a model with the live one, on the check sessions that neither was trained on."""
        live = self._models.live()
        if live is not None and live.id == model.id:
            live = None  # the model is live itself, so only the nominal model is left to compare it with
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
        """Order a check of the live model on the check sessions since it went live that were not used for this yet."""
        run = self._models.live_run()
        if run is None:
            return self._order(job, config, ())
        live = self._models.get(run.model_id)
        unseen = unseen_checks(self._models, run, checks, live.sessions)
        return self._order(job, config, unseen, live=live, live_since=run.since)

    def _order(
        self,
        job: JobFacts,
        config: Config,
        session_ids: tuple[str, ...],
        *,
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
            seed=config.jobs.seed,
            tolerance_mm=config.report.tolerance_mm,
            live_model=str(live.path) if live else None,
            live_sha256=live.manifest_sha256 if live else None,
            live_id=live.id if live else None,
            store_file=(file.device, file.inode) if file else None,
            **more,
        )

    # ---- for the runner ----------------------------------------------------------------------------------------------

    def queue(self, due: DueChain) -> None:
        """Queue new jobs: training jobs one after the other, jobs that check a model after the job that makes it.

        So a failing report does not prevent the comparison, nor the reverse.
        """
        with self._store.transaction():
            made_by: int | None = None
            for kind in due.kinds:
                job_id = self._add(kind, due.session_id, due.through_id, depends_on=made_by)
                if kind not in CHECKS:
                    made_by = job_id

    def begin(self, job: JobFacts, time_limit_s: float, host_boot: str | None = None) -> bool:
        """Mark a queued job as running and clear what earlier runs left; return False if it does not run.

        It does not if it is no longer queued. It is cancelled if an operator has rejected a session on which its model
        was trained.

        Args:
            job: the job.
            time_limit_s: how long it may run, in seconds.
            host_boot: boot id of the computer; None if unknown.
        """
        with self._store.transaction():
            row = self.table.get(job.id)
            if row["state"] != "queued":
                return False
            if (gone := self._why_void(row)) is not None:
                self.end(job.id, Outcome("cancelled", gone))
                return False
            self.table.change(
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

    def _why_void(self, row: Mapping[str, Any]) -> str | None:
        """Return why a queued job must not run, a clause; None if it may."""
        model = self._model_of(row)
        if model is None:
            return None
        unused = self._models.not_used(model.sessions, only_if_rejected=True)
        if unused is None:
            return None
        return f"session {unused[0]}, on which its model was trained, is not used any more: {unused[1]}"

    def note_process(self, job_id: int, pid: int) -> None:
        """Store the process id of a running job."""
        self.table.change(job_id, pid=pid)

    def note_progress(self, job_id: int, progress: ProgressMessage) -> None:
        """Store the progress of a running job."""
        self.table.change(job_id, progress=progress.share, message=progress.message)

    def is_cancelled(self, job_id: int) -> bool:
        """Return True if the operator has cancelled a running job."""
        return _is_cancelled(self.table.get(job_id))

    def end(self, job_id: int, outcome: Outcome, *, is_attempt: bool = True) -> Outcome:
        """End a job; if it failed or was cancelled, also cancel the jobs that depend on it.

        A clean shutdown of the daemon is not the job's fault and does not count as an attempt.

        Args:
            job_id: number of the job.
            outcome: how it ended.
            is_attempt: False if the job was interrupted through no fault of its own, which counts as an interruption
                and not as an attempt.

        Returns:
            The final outcome: a cancellation by the operator takes precedence over the process's result.
        """
        with self._store.transaction():
            job = self.table.get(job_id)
            if _is_cancelled(job):
                outcome, is_attempt = CANCELLED, True
            ended = self._store.instant(self._clock.now(), "ended_")
            is_done = outcome.state == "done"
            self.table.change(
                job_id,
                state=outcome.state,
                error=outcome.error,
                attempts=job["attempts"] - 1 if outcome == STOPPED or not is_attempt else job["attempts"],
                interruptions=job["interruptions"] + (not is_attempt),
                result_json=outcome.result,
                progress=1.0 if is_done else 0.0,
                message="",  # the last step is no longer of interest
                pid=None,
                **ended,
            )
            if outcome.result is not None and "manifest_sha256" in outcome.result:
                self._models.add(job_id, outcome.result)
            if outcome.result is not None and "comparison" in outcome.result:
                self._models.note_comparison(outcome.result["model"], outcome.result["comparison"])
            # After a decision on a check, a later job makes the sums anew; they depend on the order of the checks.
            if outcome.result is not None and "drift" in outcome.result and not self.table.is_superseded(job_id):
                note_drift(self._models, outcome.result["drift"])
            if outcome.state in {"failed", "cancelled"}:
                for waiting in self.table.chain(job_id)[1:]:
                    if waiting["state"] in {"queued", "interrupted"}:
                        why = "has failed" if outcome.state == "failed" else "was cancelled"
                        error = f"it needs job {job_id}, which {why}"
                        self.table.change(waiting["id"], state="cancelled", error=error, **ended)
            return outcome

    def interrupt_running(self, why: str, *, is_attempt: bool = True) -> None:
        """Mark jobs as interrupted that are marked as running but do not run: the scheduler queues them again.

        Args:
            why: the reason that is stored as their error.
            is_attempt: as for `end`.
        """
        for row in self.table.running():
            self.end(row["id"], Outcome("interrupted", why), is_attempt=is_attempt)

    def interrupt_left_over(self, host_boot: str) -> None:
        """Mark jobs as interrupted that the previous run of the daemon left marked as running.

        After a clean shutdown the job was stopped with the daemon, which had no time to store it. A job of an earlier
        boot was interrupted by a restart of the computer. Otherwise the daemon was killed: the job may have caused
        that, so it counts as an attempt.

        Args:
            host_boot: boot id of the computer.
        """
        for row in self.table.running():
            if row["host_boot"] not in (host_boot, None):
                cut = Outcome("interrupted", "the computer was switched off or restarted while it ran")
                self.end(row["id"], cut, is_attempt=False)
            elif self._store.ended_in_order:
                self.end(row["id"], STOPPED)
            else:
                self.end(row["id"], Outcome("interrupted", "the daemon ended while it ran"))

    # ---- for the operator --------------------------------------------------------------------------------------------

    def cancel(self, job_id: object) -> str:
        """Cancel a job that has not ended.

        Returns:
            A sentence for the operator.

        Raises:
            CommandError: the job has ended.
            NotInStoreError: there is no such job.
        """
        with self._store.transaction():
            job = self.table.get(job_id)
            if job["state"] not in CANCELLABLE:
                raise CommandError(f"job {job['id']} is {job['state']}; only a job that has not ended can be cancelled")
            if job["state"] == "running":
                # The runner finds the cancellation in the store, also after a restart.
                self.table.change(job["id"], error=CANCELLED.error)
                return f"job {job['id']} ({job['kind']}) is being cancelled"
            self.end(job["id"], CANCELLED)
            return f"job {job['id']} ({job['kind']}) is cancelled"

    def retry(self, job_id: object) -> str:
        """Queue a failed, cancelled or interrupted job again, with the jobs that depend on it; reset their attempts.

        Returns:
            A sentence for the operator.

        Raises:
            CommandError: the job is queued, running or done, or the job that it depends on must be retried first.
            NotInStoreError: there is no such job.
        """
        with self._store.transaction():
            job = self.table.get(job_id)
            if job["state"] not in RETRIABLE:
                states = "only a failed, cancelled or interrupted job can be retried"
                raise CommandError(f"job {job['id']} is {job['state']}; {states}")
            if job["depends_on"] is not None:
                before = self.table.get(job["depends_on"])
                if before["state"] in RETRIABLE:
                    raise CommandError(
                        f"job {job['id']} depends on job {before['id']}, which is {before['state']}; retry job "
                        f"{before['id']}: the jobs that depend on it follow"
                    )
            for waiting in self.table.chain(job["id"]):
                self.table.change(
                    waiting["id"], state="queued", progress=0.0, message="", error=None, attempts=0, interruptions=0
                )
            return f"job {job['id']} ({job['kind']}) is queued again"

    def compare(self, model: ModelRow) -> str:
        """Queue a comparison of a model with the live one, on all check sessions that are closed and used.

        Returns:
            A sentence for the operator.

        Raises:
            CommandError: there is no such check session.
        """
        closed = self._sessions.used()
        checks = [session["id"] for session in closed if session["kind"] == CHECK]
        if not checks:
            raise CommandError(
                "no closed check session can be used, so there are no held-out fixes to compare on; hold a check "
                "session: `rigcal session start --kind check`",
                REFUSED,
            )
        run = self._models.live_run()
        through = closed[-1]["id"]
        job_id = self._add(JobKind.COMPARISON, checks[-1], through, model_id=model.id, live_since=self._live_since(run))
        other = "the live one" if run else "its nominal stage, as no model is live"
        return f"job {job_id} will compare model {model.id} with {other}"

    def compare_again(self, model_id: int) -> str:
        """Queue a comparison of the model with this number, as `compare` does."""
        return self.compare(self._models.get(model_id))

    def _add(self, kind: JobKind, session_id: str, through_id: str, **columns: int | None) -> int:
        return self.table.add(
            self._clock.now(), kind=kind, session_id=session_id, through_session_id=through_id, **columns
        )


def _is_cancelled(job: Mapping[str, Any]) -> bool:
    """Return True if the operator has cancelled a running job, the only error that a running job can have."""
    return (job["state"], job["error"]) == ("running", CANCELLED.error)
