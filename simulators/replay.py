"""Replay of captured links instead of real ones: captures are emitted at their recorded times."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

from drivers.clock import NS_PER_S, Clock, Stamp
from drivers.readings import Capture, LinkItem


class ReplayLink:
    """A link loop that emits recorded captures when the clock reaches their stamps.

    Args:
        name: name of the link.
        captures: captures ordered by their stamps, on the monotonic clock of `clock`.
        clock: the clock; its rate is the speed of the replay.
    """

    def __init__(self, name: str, captures: Iterable[Capture], clock: Clock) -> None:
        self.name = name
        self.is_finished = threading.Event()
        self._captures = captures
        self._clock = clock

    @property
    def read_until(self) -> Stamp:
        """The current time: no received data is ever waiting to be read."""
        return self._clock.now()

    def run(self, emit: Callable[[LinkItem], None], stop: threading.Event) -> None:
        """Emit all captures, then stay silent until `stop`."""
        for capture in self._captures:
            ahead_ns = capture.stamp.monotonic_ns - self._clock.monotonic_ns()
            if ahead_ns > 0 and self._clock.wait(stop, ahead_ns / NS_PER_S):
                return
            if stop.is_set():
                return
            emit(capture)
        self.is_finished.set()
        stop.wait()
