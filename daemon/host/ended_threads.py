"""Threads that an error has ended: nobody waits for most threads, so nobody would miss one."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from types import TracebackType

log = logging.getLogger(__name__)


def log_thread_end(end: threading.ExceptHookArgs) -> None:
    """Tell the log of a thread's end, as `threading.excepthook`."""
    if _is_fault(end):
        log.critical("thread %s has ended", _name(end), exc_info=end.exc_value)


class EndedThreads:
    """Notes, while its block runs, which threads of the process end by an error that they do not catch.

    What was told of such an end before, as in the log, is told all the same.
    """

    def __init__(self) -> None:
        self._ended: dict[str, str] = {}
        self._tell = threading.excepthook

    def __enter__(self) -> EndedThreads:
        self._tell = threading.excepthook
        threading.excepthook = self._note
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        threading.excepthook = self._tell

    def found(self) -> Mapping[str, str]:
        """Return the name of each thread that has ended so -> its error, a clause; from any thread."""
        return dict(self._ended)

    def _note(self, end: threading.ExceptHookArgs) -> None:
        if _is_fault(end):
            self._ended[_name(end)] = f"{end.exc_type.__name__}: {end.exc_value}"
        self._tell(end)


def _is_fault(end: threading.ExceptHookArgs) -> bool:
    return not issubclass(end.exc_type, SystemExit)  # which is the way to end a thread on purpose


def _name(end: threading.ExceptHookArgs) -> str:
    return "unknown" if end.thread is None else end.thread.name
