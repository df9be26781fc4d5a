"""The daemon's side of a job's process: starts it with an order, reads its messages, ends it with its children."""

from __future__ import annotations

import contextlib
import logging
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import IO, Any

from daemon.host.systemd import parse_line
from daemon.jobs.job_processes import END_TIMEOUT_S, ChildProcess, JobProcess, UnitProcess
from daemon.jobs.order import Order, Outcome, ProgressMessage, Started, parse_message

log = logging.getLogger(__name__)

# -P keeps the current directory off the module search path, so that no file there is imported.
JOB_COMMAND = (sys.executable, "-P", "-m", "daemon.jobs.process")
MAX_LINE_BYTES = 16 * 2**20
MAX_LOGGED_BYTES = 4096


class JobChild:
    """A running job; a context manager that ends the process and all that it started.

    Args:
        order: sent on the process's standard input, which stays open: when it closes, the process ends.
        command: program and arguments of the child; it speaks the protocol of `daemon.jobs.order`.
        jobs_socket: socket at which systemd listens to start the job as a unit; None, or a socket at which nothing
            listens, for a child process.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, order: Order, command: Sequence[str] = JOB_COMMAND, jobs_socket: str | None = None) -> None:
        self._process = _process(command, jobs_socket)
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._job_id = order.job_id
        # Each pipe has its own thread: a pipe that the process does not read must not delay a cancellation.
        work: list[tuple[Callable[..., None], tuple[Any, ...], str]] = [(self._tell, (order.to_line(),), "-order")]
        work.append((self._read, (), ""))
        if self._process.errors is not None:
            work.append((self._log, (self._process.errors,), "-log"))
        self._threads = [
            threading.Thread(target=target, args=args, name=f"job-{order.job_id}{name}", daemon=True)
            for target, args, name in work
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int | None:
        """Process id; None until it is known."""
        return self._process.pid

    def __enter__(self) -> JobChild:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        for thread in self._threads:
            thread.join(timeout=END_TIMEOUT_S)
        with contextlib.suppress(OSError):
            self._process.orders.close()

    def next_message(self, timeout_s: float) -> Started | ProgressMessage | Outcome | None:
        """Return the next message of the process, including its end; None if none arrives within `timeout_s`."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            return None
        message = parse_message(line) if line else Outcome("failed", self._process.last_words())
        if isinstance(message, Started):
            self._process.identify(message.pid)
        return message

    def _tell(self, line: bytes) -> None:
        with contextlib.suppress(OSError):  # the process has died, which the end of its output shows
            self._process.orders.write(line)
            self._process.orders.flush()

    def _read(self) -> None:
        """Queue the lines of the process's output, and b"" at its end."""
        with contextlib.suppress(OSError), self._process.messages as output:  # the connection was reset
            while line := output.readline(MAX_LINE_BYTES):
                self._lines.put(line)
        self._lines.put(b"")

    def _log(self, errors: IO[bytes]) -> None:
        """Log the lines of the process's standard error with the priorities that they carry."""
        with errors:
            while line := errors.readline(MAX_LOGGED_BYTES):
                level, text = parse_line(line.rstrip().decode("utf-8", "replace"))
                log.log(level, "job %d: %s", self._job_id, text)


def _process(command: Sequence[str], jobs_socket: str | None) -> JobProcess:
    if jobs_socket is not None:
        try:
            return UnitProcess(jobs_socket)
        except OSError as error:
            log.warning(
                "systemd does not listen for jobs at %s (%s), so the job runs as a child of the daemon, with a lower "
                "priority but no limits of its own; run `systemctl start rigcal-jobs.socket`",
                jobs_socket,
                error.strerror or error,
            )
    return ChildProcess(command)
