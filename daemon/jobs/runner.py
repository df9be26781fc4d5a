"""Runs jobs: queues those that are due, runs one process at a time, and stores progress and outcome.

The runner is one thread of the daemon. A job's process (`daemon.jobs.process`) reads the store and writes progress and
result to its standard output; only the daemon writes to the store.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from daemon.commands import REFUSED, CommandError
from daemon.config.config import Config
from daemon.host.worker_thread import WorkerThread
from daemon.jobs.child import JOB_COMMAND, JobChild
from daemon.jobs.job_queue import CANCELLED, STOPPED, JobQueue
from daemon.jobs.order import Outcome, Started
from daemon.jobs.scheduler import DueChain, DueComparison, awaited_session, due_jobs, next_job, spent_jobs
from daemon.store.errors import LACKING
from daemon.store.queries.jobs import JobFacts
from daemon.store.queries.models import ModelRow
from daemon.store.store import Store
from drivers.clock import NS_PER_S, Clock, SystemClock

log = logging.getLogger(__name__)

POLL_S = 0.5
LISTEN_S = 0.2  # how often a running job that sends nothing is checked
STOP_TIMEOUT_S = 30.0


class JobRunner(WorkerThread):
    """Queues and runs jobs until stopped.

    `stop` ends the running job, which is marked interrupted and queued again after the next start.

    Args:
        store: where jobs, their results and models are written.
        config: limits, seed and paths.
        rig_name: rig whose sessions are used.
        clock: for the times of changes.
        command: program and arguments that carry out an order, with the protocol of `daemon.jobs.order`.
        jobs_socket: socket at which systemd listens to start each job as a unit; None to run jobs as children.
        is_held: returns True while no job may start.
        work_clock: the host's clock, for durations of work; the rig's clock may run at a different rate.
    """

    def __init__(
        self,
        store: Store,
        config: Config,
        rig_name: str,
        clock: Clock,
        *,
        command: Sequence[str] = JOB_COMMAND,
        jobs_socket: str | None = None,
        is_held: Callable[[], bool] = lambda: False,
        work_clock: Clock | None = None,
    ) -> None:
        super().__init__("jobs", STOP_TIMEOUT_S)
        self._settings = config.jobs
        self._config = config
        self._clock = clock
        self._command, self._jobs_socket = command, jobs_socket
        self._is_held = is_held
        self._work_clock = work_clock or SystemClock()
        self._host_boot = self._work_clock.now().boot_id
        self._store = store
        self._queue = JobQueue(store, rig_name, clock)
        self._is_computer_at_fault = False  # whether the last step failed through no fault of a job
        self._told = ""  # the last error of this thread that was logged
        store.unless_damaged(lambda: self._queue.interrupt_left_over(self._host_boot), None)

    def compare(self, model: ModelRow) -> str:
        """Queue a comparison of a model with the live model, and return a sentence for the operator.

        Raises:
            CommandError: there is no held-out session, or jobs are disabled.
        """
        if not self._settings.enabled:
            raise CommandError(
                f"model {model.id} cannot be compared: jobs are disabled; set [jobs] enabled = true in the "
                "configuration and restart rigcal",
                REFUSED,
            )
        return self._queue.compare(model)

    def awaited_session(self) -> str | None:
        """Return the session whose jobs will be queued soon unless a new session starts; None if there is none."""
        return awaited_session(self._queue.state()) if self._settings.enabled else None

    # ---- commands of the operator ------------------------------------------------------------------------------------

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return all jobs with their results and their durations in real time, newest last."""
        return self._queue.table.all(self._clock)

    def cancel_command(self, arguments: Mapping[str, Any]) -> str:
        """Cancel a job that has not ended, and the jobs that depend on it."""
        return self._queue.cancel(arguments.get("id"))

    def retry_command(self, arguments: Mapping[str, Any]) -> str:
        """Queue a failed, cancelled or interrupted job again, together with the jobs that depend on it."""
        return self._queue.retry(arguments.get("id"))

    # ---- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                did_something = self._step()
                self._told = ""
            except Exception as error:
                self._is_computer_at_fault = isinstance(error, sqlite3.Error) or (
                    isinstance(error, OSError) and error.errno in LACKING
                )
                if str(error) != self._told:  # a damaged table would otherwise fill the log
                    log.exception("the scheduler has failed and will try again")
                self._told = str(error)
                did_something = False
            if not did_something:
                self._stopping.wait(POLL_S)

    def _step(self) -> bool:
        """Queue the jobs that are due and run the next one; return True if a job ran."""
        state = self._queue.state()
        if any(job.state == "running" for job in state.jobs):
            # No job runs between two steps, so the last step failed. The job is not to blame for a full disk, nor for a
            # lack of descriptors or memory that kept its process from starting.
            self._queue.interrupt_running(
                "an error of the daemon stopped it; see the daemon's log", is_attempt=not self._is_computer_at_fault
            )
            return False
        if self._is_held():
            return False
        for job in spent_jobs(state, max_attempts=self._settings.max_attempts):
            self._abandon(job)
        due = due_jobs(state, self._clock.now(), max_attempts=self._settings.max_attempts)
        for item in due:
            if isinstance(item, DueChain):
                self._queue.queue(item)
            elif isinstance(item, DueComparison):
                log.info("a different model is live: %s", self._queue.compare_again(item.model_id))
            elif self._queue.table.offer_again(item.job_id):
                log.info("job %d is queued again after an interruption", item.job_id)
        next_one = next_job(self._queue.state() if due else state)
        if next_one is None:
            return False
        if not self._queue.begin(next_one, self._settings.time_limit_s, self._host_boot):
            row = self._queue.table.get(next_one.id)
            _log_end(next_one, Outcome(row["state"], row["error"]))
            return False
        self._perform(next_one)
        return True

    def _abandon(self, job: JobFacts) -> None:
        if job.attempts >= self._settings.max_attempts:
            often = f"interrupted {job.attempts} times, the most that [jobs] max_attempts allows"
        else:
            often = (
                f"interrupted {job.interruptions} times through no fault of its own, which points to a fault of the "
                "computer"
            )
        error = f"{often}; `rigcal jobs retry {job.id}` tries again"
        log.warning("job %d (%s) is abandoned: %s", job.id, job.kind, error)
        self._queue.end(job.id, Outcome("failed", error))

    def _perform(self, job: JobFacts) -> None:
        """Run one job to its end."""
        log.info("job %d (%s for session %s) starts", job.id, job.kind, job.session_id)
        with JobChild(self._queue.order(job, self._config), self._command, self._jobs_socket) as child:
            if child.pid is not None:
                self._queue.note_process(job.id, child.pid)
            outcome = self._follow(job.id, child)
        is_cut_off = outcome.state == "failed" and self._is_store_gone()
        if is_cut_off:  # the process found no store or a different one; the job waits until the daemon's file is back
            outcome = Outcome("interrupted", outcome.error)
        outcome = self._queue.end(job.id, outcome, is_attempt=not is_cut_off)
        _log_end(job, outcome)

    def _is_store_gone(self) -> bool:
        """Return True if the file at the store's path is missing or not the one that was opened."""
        try:
            return self._store.files.changed() is not None
        except OSError:
            return True

    def _follow(self, job_id: int, child: JobChild) -> Outcome:
        """Store a process's progress until it sends a result, dies, is cancelled, or reaches its time limit."""
        limit_s = self._settings.time_limit_s
        deadline_ns = self._work_clock.monotonic_ns() + int(limit_s * NS_PER_S)
        while True:
            if self._stopping.is_set():
                return STOPPED
            if self._queue.is_cancelled(job_id):
                return CANCELLED
            if self._work_clock.monotonic_ns() > deadline_ns:
                return Outcome("failed", f"took longer than its limit of {limit_s:g} s ([jobs] time_limit_s)")
            message = child.next_message(LISTEN_S)
            if isinstance(message, Outcome):
                return message
            if isinstance(message, Started):
                self._queue.note_process(job_id, message.pid)
            elif message is not None:
                self._queue.note_progress(job_id, message)


def _log_end(job: JobFacts, outcome: Outcome) -> None:
    level = logging.INFO if outcome.state == "done" else logging.WARNING
    why = f": {outcome.error}" if outcome.error else ""
    log.log(level, "job %d (%s) is %s%s", job.id, job.kind, outcome.state, why)
