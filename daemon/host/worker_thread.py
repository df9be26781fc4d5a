"""A background thread of the service: it starts once, and ends when it is asked to or when the process does."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod


class WorkerThread(ABC):
    """Base of the parts of the service that work in a thread of their own.

    Args:
        name: name of the thread, for logs and alarms.
        stop_s: longest time to wait for its end, real seconds.
    """

    def __init__(self, name: str, stop_s: float) -> None:
        self._stop_s = stop_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end, and wait for its end. Does nothing if it was not started."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(self._stop_s)

    @abstractmethod
    def _run(self) -> None:
        """Work until `_stopping` is set."""
