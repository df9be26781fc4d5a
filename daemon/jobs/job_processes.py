"""Processes of jobs: a unit that systemd starts for a connection, or else a child of the daemon (decision 0028).

Either reads its order from standard input, which stays open until the job ends or is cancelled, and writes its messages
to standard output (`daemon.jobs.order`).
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
from collections.abc import Sequence
from typing import IO, Protocol

from daemon.host.priority import JOB_NICE, lower_priority

JOBS_SOCKET = "RIGCAL_JOBS_SOCKET"  # environment variable: path of the socket at which systemd listens for jobs
END_TIMEOUT_S = 5.0  # from the end of a process's output to the end of the process
CONNECT_TIMEOUT_S = 5.0


class JobProcess(Protocol):
    """A process that carries out an order.

    Attributes:
        pid: process id; None until it is known.
        orders: its standard input.
        messages: its standard output.
        errors: its standard error; None if systemd sends it to the journal.
    """

    pid: int | None
    orders: IO[bytes]
    messages: IO[bytes]
    errors: IO[bytes] | None

    def identify(self, pid: int) -> None:
        """Take the process id that the process reports."""

    def last_words(self) -> str:
        """Return how the process ended, for one that sent no result."""

    def kill(self) -> None:
        """End the process and all that it has started."""


class ChildProcess:
    """A child of the daemon, with its own process group and a lower priority.

    Args:
        command: program and arguments.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.pid: int | None = self._process.pid
        self.orders: IO[bytes] = self._process.stdin
        self.messages: IO[bytes] = self._process.stdout
        self.errors: IO[bytes] | None = self._process.stderr
        lower_priority(JOB_NICE, self._process.pid)

    def identify(self, pid: int) -> None:
        """Do nothing: the process id of a child is known."""

    def last_words(self) -> str:
        try:
            status = self._process.wait(timeout=END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return "its process closed its output without a result"
        if status < 0:
            return f"its process was killed by signal {-status} ({signal.strsignal(-status)}) before it had a result"
        return f"its process ended with status {status} and no result; see the daemon's log"

    def kill(self) -> None:
        # Until it is waited for, the process keeps its group id, so no other group can have that id.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class UnitProcess:
    """The main process of a unit `rigcal-jobs@.service`, which systemd starts for a connection.

    The unit and its slice set its limits, its standard error goes to the journal, and systemd ends its children with
    it. It first sends its process id, which the connection does not show because systemd created the socket.

    Args:
        path: of the socket at which systemd listens.

    Raises:
        OSError: nothing listens at the socket.
    """

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(CONNECT_TIMEOUT_S)
            self._socket.connect(path)
            self._socket.settimeout(None)
        except OSError:
            self._socket.close()
            raise
        self.pid: int | None = None
        self.orders: IO[bytes] = self._socket.makefile("wb")
        self.messages: IO[bytes] = self._socket.makefile("rb")
        self.errors: IO[bytes] | None = None
        self._process_fd: int | None = None

    def identify(self, pid: int) -> None:
        """Open a descriptor of the process: by the time it is ended, its process id may have been reused."""
        if self._process_fd is None and pid not in (os.getpid(), os.getppid()) and pid > 1:
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                self._process_fd = os.pidfd_open(pid)
                self.pid = pid

    def last_words(self) -> str:
        return (
            "its process ended without a result: it reached its memory limit, or it failed; "
            "see `journalctl -u 'rigcal-jobs@*'`"
        )

    def kill(self) -> None:
        with contextlib.suppress(OSError):  # closed by the other end
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        if self._process_fd is None:
            return  # the process ends when its input closes
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._process_fd, signal.SIGKILL)
        end = select.poll()
        end.register(self._process_fd, select.POLLIN)  # readable once it has ended
        end.poll(END_TIMEOUT_S * 1e3)
        os.close(self._process_fd)
        self._process_fd = None
