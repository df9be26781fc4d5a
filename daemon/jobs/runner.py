"""Runs jobs: queues what is due, one process at a time, and writes down what becomes of it.

The runner is one thread of the daemon. A job's process (`daemon.jobs.process`) reads the store and tells progress and
result on its standard output; only the daemon writes.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from daemon.commands import REFUSED, CommandError
from daemon.config.config import Config
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
LISTEN_S = 0.2  # a running job that is silent is looked after this often
STOP_TIMEOUT_S = 30.0


class JobRunner:
    """Queues and runs jobs until stopped.

    Args:
        store: where jobs, their results and models are written.
        config: limits, seed and places.
        rig_name: whose sessions are used.
        clock: time.
        command: what carries out an order, with the protocol of `daemon.jobs.order`.
        jobs_socket: where systemd listens, to start each job as a unit of its own; None: jobs are children.
        is_held: true while nothing may be started.
        work_clock: of the computer; work takes real time, whatever the rig's clock does.
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
        self._settings = config.jobs
        self._config = config
        self._clock = clock
        self._command, self._jobs_socket = command, jobs_socket
        self._is_held = is_held
        self._work_clock = work_clock or SystemClock()
        self._host_boot = self._work_clock.now().boot_id
        self._store = store
        self._queue = JobQueue(store, rig_name, clock)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)
        self._is_computer_at_fault = False  # for a step that failed
        self._told = ""  # the fault of this thread that the log has last
        store.unless_damaged(lambda: self._queue.interrupt_left_over(self._host_boot), None)

    def start(self) -> None:
        """Begin to queue and run."""
        self._thread.start()

    def stop(self) -> None:
        """End the running job (it is marked interrupted, and offered again at the next start) and the thread."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=STOP_TIMEOUT_S)

    def compare(self, model: ModelRow) -> str:
        """Queue a comparison of a model with the live one and say so.

        Raises:
            CommandError: nothing is held out, or no job would ever run.
        """
        if not self._settings.enabled:
            raise CommandError(
                f"model {model.id} cannot be compared: jobs are switched off; set [jobs] enabled = true in the "
                "configuration and start rigcal again",
                REFUSED,
            )
        return self._queue.compare(model)

    def awaited_session(self) -> str | None:
        """Return the session whose jobs are queued in a moment, unless a next one begins; None without one."""
        return awaited_session(self._queue.state()) if self._settings.enabled else None

    # ---- commands of the operator ------------------------------------------------------------------------------------

    def list_command(self, _arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
        """All jobs with their results and how long they took in real time, newest last."""
        return self._queue.table.all(self._clock)

    def cancel_command(self, arguments: Mapping[str, Any]) -> str:
        """Cancel a job that has not ended, and with it those that wait for it."""
        return self._queue.cancel(arguments.get("id"))

    def retry_command(self, arguments: Mapping[str, Any]) -> str:
        """Queue a job that failed, was cancelled or was interrupted again, and with it those that waited for it."""
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
                if str(error) != self._told:  # a damaged table would fill the log
                    log.exception("the scheduler has failed; it goes on")
                self._told = str(error)
                did_something = False
            if not did_something:
                self._stopping.wait(POLL_S)

    def _step(self) -> bool:
        """Queue what is due and run what is next; True if a job ran."""
        state = self._queue.state()
        if any(job.state == "running" for job in state.jobs):
            # None runs between two steps: the last step failed. A full disk is not the job's doing, nor is a lack of
            # descriptors or memory that keeps its process from being started.
            self._queue.interrupt_running(
                "the daemon could not see it through; its log may tell why", is_attempt=not self._is_computer_at_fault
            )
            return False
        if self._is_held():
            return False
        for job in spent_jobs(state, max_attempts=self._settings.max_attempts):
            self._give_up(job)
        due = due_jobs(state, self._clock.now(), max_attempts=self._settings.max_attempts)
        for item in due:
            if isinstance(item, DueChain):
                self._queue.queue(item)
            elif isinstance(item, DueComparison):
                log.info("another model is live: %s", self._queue.compare_again(item.model_id))
            elif self._queue.table.offer_again(item.job_id):
                log.info("job %d is offered again after an interruption", item.job_id)
        next_one = next_job(self._queue.state() if due else state)
        if next_one is None or not self._queue.begin(next_one, self._settings.time_limit_s, self._host_boot):
            return False
        self._perform(next_one)
        return True

    def _give_up(self, job: JobFacts) -> None:
        if job.attempts >= self._settings.max_attempts:
            often = f"interrupted {job.attempts} times, as often as [jobs] max_attempts allows"
        else:
            often = (
                f"cut off {job.interruptions} times by what is not its own fault; something is wrong with the computer"
            )
        error = f"{often}; `rigcal jobs retry {job.id}` tries once more"
        log.warning("job %d (%s) is given up: %s", job.id, job.kind, error)
        self._queue.end(job.id, Outcome("failed", error))

    def _perform(self, job: JobFacts) -> None:
        """Run one job to its end."""
        log.info("job %d (%s for session %s) starts", job.id, job.kind, job.session_id)
        with JobChild(self._queue.order(job, self._config), self._command, self._jobs_socket) as child:
            if child.pid is not None:
                self._queue.note_process(job.id, child.pid)
            outcome = self._follow(job.id, child)
        is_cut_off = outcome.state == "failed" and self._is_store_gone()
        if is_cut_off:  # its process read another store than the daemon's, or none: it waits until the file is back
            outcome = Outcome("interrupted", outcome.error)
        outcome = self._queue.end(job.id, outcome, is_attempt=not is_cut_off)
        level = logging.INFO if outcome.state == "done" else logging.WARNING
        why = f": {outcome.error}" if outcome.error else ""
        log.log(level, "job %d (%s) is %s%s", job.id, job.kind, outcome.state, why)

    def _is_store_gone(self) -> bool:
        """True if another file, or none, lies where the store was opened."""
        try:
            return self._store.files.changed() is not None
        except OSError:
            return True

    def _follow(self, job_id: int, child: JobChild) -> Outcome:
        """Write down a process's progress until it tells a result, dies, is cancelled, or its time is up."""
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
