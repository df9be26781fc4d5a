"""Threads that an error has ended: most threads are never joined, so their end would go unnoticed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from types import TracebackType

log = logging.getLogger(__name__)


def log_thread_end(end: threading.ExceptHookArgs) -> None:
    """Log the end of a thread by an error; for use as `threading.excepthook`."""
    if _is_fault(end):
        log.critical("thread %s has ended", _name(end), exc_info=end.exc_value)


class EndedThreads:
    """Records, while its block runs, which threads of the process end by an uncaught error.

    The previous `threading.excepthook`, which logs such an end, is still called.
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
        """Return the name of each thread that an error has ended -> the error, a clause; for any thread to call."""
        return dict(self._ended)

    def _note(self, end: threading.ExceptHookArgs) -> None:
        if _is_fault(end):
            self._ended[_name(end)] = f"{end.exc_type.__name__}: {end.exc_value}"
        self._tell(end)


def _is_fault(end: threading.ExceptHookArgs) -> bool:
    return not issubclass(end.exc_type, SystemExit)  # SystemExit ends a thread on purpose


def _name(end: threading.ExceptHookArgs) -> str:
    return "unknown" if end.thread is None else end.thread.name
