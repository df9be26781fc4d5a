"""systemd: log lines with a priority for its journal, hints on its sandbox, its readiness and watchdog protocol.

A log line may quote an instrument, a file or a client. Therefore unsafe characters are escaped, a message is one line,
and the lines of a traceback are indented, so that quoted text cannot look like a separate log line.

Sources: sd-daemon(3), sd_notify(3), systemd.exec(5).
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import socket
import sys
import threading
import weakref
from collections.abc import Iterator, Mapping
from typing import TextIO

from daemon.host.ended_threads import log_thread_end
from daemon.host.safe_output import shown
from drivers.clock import TimeBudget

_PLAIN = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_PREFIXED = "%(name)s: %(message)s"  # the journal has the time
_INDENT = "    "
_PRIORITIES = {"2": logging.CRITICAL, "3": logging.ERROR, "4": logging.WARNING, "6": logging.INFO, "7": logging.DEBUG}
_LINE = re.compile(r"<([0-7])>(.*)", re.DOTALL)
EXTEND_EVERY_S = 20.0
EXTEND_BY_S = 60
EXTEND_LIMIT_S = 1800.0  # a start that takes longer is considered to hang

log = logging.getLogger(__name__)


class LineFormatter(logging.Formatter):
    """Formats log records as lines that are safe to show.

    Args:
        is_prefixed: each line begins with its priority as in sd-daemon(3), and has no timestamp.
    """

    def __init__(self, *, is_prefixed: bool) -> None:
        super().__init__(_PREFIXED if is_prefixed else _PLAIN)
        self._is_prefixed = is_prefixed

    def format(self, record: logging.LogRecord) -> str:
        record.message = record.getMessage().rstrip("\n")
        if self.usesTime():
            record.asctime = self.formatTime(record)
        lines = [shown(self.formatMessage(record))]
        trace = self.formatException(record.exc_info) if record.exc_info else ""
        for more in (trace, record.stack_info):
            if more:
                lines += (_INDENT + shown(line) for line in more.split("\n"))
        prefix = priority_prefix(record.levelno) if self._is_prefixed else ""
        return "\n".join(prefix + line for line in lines)


def set_up_logging(*, level: int = logging.INFO, is_prefixed: bool | None = None) -> None:
    """Send log records, warnings of libraries and uncaught exceptions of threads to standard error.

    Args:
        level: lowest level that is sent.
        is_prefixed: each line begins with its priority; None for True if standard error is the journal.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(LineFormatter(is_prefixed=is_journal(sys.stderr) if is_prefixed is None else is_prefixed))
    logging.basicConfig(level=level, handlers=[handler])
    logging.captureWarnings(True)
    threading.excepthook = log_thread_end


def escape_unhandled_records() -> None:
    """Escape log records that no handler takes, such as warnings of libraries in a command that sets up no logging."""
    assert logging.lastResort is not None
    logging.lastResort.setFormatter(LineFormatter(is_prefixed=is_journal(sys.stderr)))


def is_journal(stream: TextIO) -> bool:
    """Return True if a stream goes to the journal: it is the one that JOURNAL_STREAM names (systemd.exec(5))."""
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


def priority_prefix(level: int) -> str:
    """Return the prefix that gives a line's priority to the journal."""
    priority = next((p for p, least in _PRIORITIES.items() if level >= least), "7")
    return f"<{priority}>"


def parse_line(line: str) -> tuple[int, str]:
    """Return the level and the text of a line that may begin with a priority; without one it is a warning.

    Output of a library on standard error has no priority, and usually reports a problem.
    """
    found = _LINE.match(line)
    if found is None:
        return logging.WARNING, line
    return _PRIORITIES.get(found[1], logging.INFO if found[1] == "5" else logging.CRITICAL), found[2]


def network_hint(error: object, environ: Mapping[str, str] = os.environ) -> str:
    """Return a hint where the service's unit forbids a connection; "" for any other error and outside a service."""
    is_forbidden = isinstance(error, socket.gaierror) or (
        isinstance(error, OSError) and error.errno in (errno.EAFNOSUPPORT, errno.EPERM)
    )
    if not is_forbidden or "INVOCATION_ID" not in environ:  # set for each service, systemd.exec(5)
        return ""
    return " (the service has no network unless network.conf allows it: see `The network` in deploy/README.md)"


# ---- readiness and watchdog ----------------------------------------------------------------------------------------


class Notifier:
    """Reports the state of the service to systemd; does nothing when not started by systemd.

    Args:
        environ: the environment, with NOTIFY_SOCKET and WATCHDOG_USEC.
    """

    def __init__(self, environ: os._Environ[str] | dict[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._is_heard = True
        if self._address:
            # Opened once: a heartbeat must not need a descriptor when there are none left.
            self._channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            weakref.finalize(self, self._channel.close)
        usec = environ.get("WATCHDOG_USEC", "")
        own = environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(usec) / 1e6 if usec.isdigit() and own else None

    def send(self, *states: str) -> None:
        """Send states such as `READY=1`, `STOPPING=1`, `WATCHDOG=1`, `STATUS=...`; a failure to send is logged."""
        if not self._address:
            return
        try:
            self._channel.sendto("\n".join(map(shown, states)).encode(), self._address)
        except OSError as error:
            if self._is_heard:
                log.warning("the service manager cannot be reached at %s: %s", self._address, error.strerror)
            self._is_heard = False
        else:
            self._is_heard = True

    @contextlib.contextmanager
    def extending(self, status: str) -> Iterator[None]:
        """Extend systemd's TimeoutStartSec while the block runs.

        A store takes long to open if a new version migrates it, or if a power cut left a long write-ahead log.

        Args:
            status: what is being done, for `systemctl status`.
        """
        if not self._address:
            yield
            return
        done = threading.Event()

        def extend() -> None:
            limit = TimeBudget(EXTEND_LIMIT_S)
            while not limit.is_over:
                self.send(f"EXTEND_TIMEOUT_USEC={EXTEND_BY_S * 1_000_000}", f"STATUS={status}")
                if done.wait(EXTEND_EVERY_S):
                    return

        thread = threading.Thread(target=extend, name="start-time", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
