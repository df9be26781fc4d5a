"""A job's process, seen from the daemon: started with an order, listened to, and ended with all that it started."""

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
from daemon.jobs.order import Order, Outcome, Progress, Started, parse_message

log = logging.getLogger(__name__)

# -P keeps the current directory off the process's path: what lies there is no code of ours.
JOB_COMMAND = (sys.executable, "-P", "-m", "daemon.jobs.process")
MAX_LINE_BYTES = 16 * 2**20
MAX_LOGGED_BYTES = 4096


class JobChild:
    """A running job; a context manager that leaves nothing of it behind.

    Args:
        order: what to do, told on standard input, which stays open: the process ends when its parent is gone.
        command: what does it, with the protocol of `daemon.jobs.order` on standard output.
        jobs_socket: where systemd listens, to start a unit in place of a child; a child where nothing listens there.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, order: Order, command: Sequence[str] = JOB_COMMAND, jobs_socket: str | None = None) -> None:
        self._process = _process(command, jobs_socket)
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._job_id = order.job_id
        # All pipes have a thread of their own: one that the process does not empty must not hold up a cancellation.
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
        """Number of the process; None as long as it has not told."""
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

    def next_message(self, timeout_s: float) -> Started | Progress | Outcome | None:
        """Return the process's next message, its end included; None when it says nothing for `timeout_s`."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            return None
        message = parse_message(line) if line else Outcome("failed", self._process.last_words())
        if isinstance(message, Started):
            self._process.identify(message.pid)
        return message

    def _tell(self, line: bytes) -> None:
        with contextlib.suppress(OSError):  # it died first, and the end of its output will tell
            self._process.orders.write(line)
            self._process.orders.flush()

    def _read(self) -> None:
        """Lines of the process's output, and b"" at its end."""
        with contextlib.suppress(OSError), self._process.messages as output:  # a connection that was reset
            while line := output.readline(MAX_LINE_BYTES):
                self._lines.put(line)
        self._lines.put(b"")

    def _log(self, errors: IO[bytes]) -> None:
        """Log what the process says on standard error, each line as important as it says."""
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
                "systemd does not listen for jobs at %s (%s), so the job runs beside acquisition, with a lower "
                "priority alone; `systemctl start rigcal-jobs.socket`",
                jobs_socket,
                error.strerror or error,
            )
    return ChildProcess(command)
