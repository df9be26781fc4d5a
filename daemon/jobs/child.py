"""A job's process, seen from the daemon: started with an order, listened to, and ended with all that it started."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from types import TracebackType

from daemon.host.systemd import parse_line
from daemon.jobs.order import Order, Outcome, Progress, parse_message

log = logging.getLogger(__name__)

# -P keeps the current directory off the process's path: what lies there is no code of ours.
JOB_COMMAND = (sys.executable, "-P", "-m", "daemon.jobs.process")
NICE = 10  # of a job and all that it starts: acquisition comes first
MAX_LINE_BYTES = 16 * 2**20
MAX_LOGGED_BYTES = 4096
END_TIMEOUT_S = 5.0  # from the end of a process's output to its own


class JobChild:
    """A running job; a context manager that leaves nothing of it behind.

    Args:
        order: what to do, told on standard input, which stays open: the process ends when its parent is gone.
        command: what does it, with the protocol of `daemon.jobs.order` on standard output.

    Attributes:
        pid: of the process, which leads a process group of its own.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, order: Order, command: Sequence[str] = JOB_COMMAND) -> None:
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        self.pid = self._process.pid
        with contextlib.suppress(ProcessLookupError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, self.pid, max(NICE, os.getpriority(os.PRIO_PROCESS, 0)))
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._job_id = order.job_id
        # All pipes have a thread of their own: one that the process does not empty must not hold up a cancellation.
        self._threads = [
            threading.Thread(target=self._tell, args=(order.to_line(),), name=f"job-{order.job_id}-order", daemon=True),
            threading.Thread(target=self._read, name=f"job-{order.job_id}", daemon=True),
            threading.Thread(target=self._log, name=f"job-{order.job_id}-log", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> JobChild:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Unwaited for, the process keeps its group's number, so that no other group can have it.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        for thread in self._threads:
            thread.join(timeout=END_TIMEOUT_S)
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def next_message(self, timeout_s: float) -> Progress | Outcome | None:
        """Return the process's next message, its end included; None when it says nothing for `timeout_s`."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            return None
        return parse_message(line) if line else Outcome("failed", self._last_words())

    def _last_words(self) -> str:
        """Tell the end of a process that told no result."""
        try:
            status = self._process.wait(timeout=END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return "its process closed its output without a result"
        if status < 0:
            return f"its process was killed by signal {-status} ({signal.strsignal(-status)}) before it told a result"
        return f"its process ended with status {status} and no result; the daemon's log may tell why"

    def _tell(self, line: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it died first, and the end of its output will tell
            self._process.stdin.write(line)
            self._process.stdin.flush()

    def _read(self) -> None:
        """Lines of the process's output, and b"" at its end."""
        assert self._process.stdout is not None
        with self._process.stdout as output:
            while line := output.readline(MAX_LINE_BYTES):
                self._lines.put(line)
        self._lines.put(b"")

    def _log(self) -> None:
        """Log what the process says on standard error, each line as important as it says."""
        assert self._process.stderr is not None
        with self._process.stderr as errors:
            while line := errors.readline(MAX_LOGGED_BYTES):
                level, text = parse_line(line.rstrip().decode("utf-8", "replace"))
                log.log(level, "job %d: %s", self._job_id, text)
