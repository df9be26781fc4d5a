"""Background threads of the service: each starts once, and ends when it is asked to or when the process does."""

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


class WokenThread(WorkerThread):
    """A thread that works each time it is woken, and once more before it ends.

    Args:
        name, stop_s: as for `WorkerThread`.
    """

    def __init__(self, name: str, stop_s: float) -> None:
        super().__init__(name, stop_s)
        self._woken = threading.Event()

    def wake(self) -> None:
        """Let the thread work soon, without waiting for that; from any thread."""
        self._woken.set()

    def stop(self) -> None:
        """Let the thread do what is pending, and wait for its end."""
        self._stopping.set()
        self.wake()
        super().stop()

    def _run(self) -> None:
        is_last = False
        while not is_last:
            self._woken.wait(self._patience_s())
            self._woken.clear()
            is_last = self._stopping.is_set()  # asked before the work: what is pending at a stop is still done
            self._work()

    def _patience_s(self) -> float | None:
        """Return how long to wait if nobody wakes the thread, real seconds; None for ever."""
        return None

    @abstractmethod
    def _work(self) -> None:
        """Do all that is pending; must not raise."""
