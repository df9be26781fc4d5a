"""Processes of jobs: a unit that systemd starts for a connection, or else a child of the daemon (decision 0028).

Either reads its order from standard input, which stays open as long as the daemon wants the job, and tells its messages
on standard output (`daemon.jobs.order`).
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

JOBS_SOCKET = "RIGCAL_JOBS_SOCKET"  # environment variable: where systemd listens for jobs
END_TIMEOUT_S = 5.0  # from the end of a process's output to its own
CONNECT_TIMEOUT_S = 5.0


class JobProcess(Protocol):
    """A process that carries out an order.

    Attributes:
        pid: of the process; None as long as it has not told.
        orders: its standard input.
        messages: its standard output.
        errors: its standard error; None where that goes to the journal by itself.
    """

    pid: int | None
    orders: IO[bytes]
    messages: IO[bytes]
    errors: IO[bytes] | None

    def identify(self, pid: int) -> None:
        """Take the number that the process tells of itself."""

    def last_words(self) -> str:
        """Tell the end of a process that told no result."""

    def kill(self) -> None:
        """End the process and all that it has started."""


class ChildProcess:
    """A child of the daemon, which leads a process group of its own and has a lower priority.

    Args:
        command: program and arguments.

    Raises:
        OSError: it cannot be started.
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
        """Nothing to take: the number of a child is known."""

    def last_words(self) -> str:
        try:
            status = self._process.wait(timeout=END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return "its process closed its output without a result"
        if status < 0:
            return f"its process was killed by signal {-status} ({signal.strsignal(-status)}) before it told a result"
        return f"its process ended with status {status} and no result; the daemon's log may tell why"

    def kill(self) -> None:
        # Unwaited for, the process keeps its group's number, so that no other group can have it.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class UnitProcess:
    """The main process of a unit `rigcal-jobs@.service`, which systemd starts for a connection.

    Its limits are those of the unit and of its slice, its standard error goes to the journal, and what it has started
    systemd ends with it. It tells its number first: a connection does not show it, for systemd had made the socket.

    Args:
        path: of the socket that systemd listens at.

    Raises:
        OSError: nothing listens there.
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
        """Take hold of the process by a descriptor: its number may be another one's by the time it is ended."""
        if self._process_fd is None and pid not in (os.getpid(), os.getppid()) and pid > 1:
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                self._process_fd = os.pidfd_open(pid)
                self.pid = pid

    def last_words(self) -> str:
        return (
            "its process ended without a result: it ran into its memory limit, or it failed; "
            "`journalctl -u 'rigcal-jobs@*'` tells why"
        )

    def kill(self) -> None:
        with contextlib.suppress(OSError):  # closed by the other end
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        if self._process_fd is None:
            return  # the end of its input ends it
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._process_fd, signal.SIGKILL)
        end = select.poll()
        end.register(self._process_fd, select.POLLIN)  # readable once it has ended
        end.poll(END_TIMEOUT_S * 1e3)
        os.close(self._process_fd)
        self._process_fd = None
