"""The computer's clock, watched: read again and again, and the loss of its synchronisation noticed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from daemon.host.time_service import ClockState
from drivers.clock import NS_PER_S, Clock, Stamp

log = logging.getLogger(__name__)

EVERY_S = 60.0
STOP_S = 5.0


class TimeWatch:
    """Reads the state of the computer's clock, in a thread of its own: an answer may take seconds.

    A rig without a network is never synchronised, which is no news. That a clock no longer is, is.

    Args:
        read: returns the state.
        clock: time of the readings.
    """

    def __init__(self, read: Callable[[], ClockState], clock: Clock) -> None:
        self._read, self._clock = read, clock
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._known: tuple[ClockState, Stamp] | None = None
        self._kept: Stamp | None = None  # when it was last seen to be synchronised
        self._told = ""

    def start(self) -> None:
        """Begin."""
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End. Harmless when not started."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(STOP_S)

    def look(self) -> None:
        """Read the state now."""
        state, now = self._read(), self._clock.now()
        if state.is_synchronized:
            self._kept = now
        self._known = state, now
        if state.error != self._told:
            self._told = state.error
            if state.error:
                log.info("the state of the computer's clock is not known: %s", state.error)

    @property
    def state(self) -> ClockState | None:
        """The newest state; None before the first."""
        known = self._known
        return None if known is None else known[0]

    def lost(self) -> Stamp | None:
        """Return when the clock was last synchronised, if it no longer is; None where it is, or never was."""
        state = self.state
        return self._kept if state is not None and state.is_synchronized is False else None

    def status(self) -> dict[str, Any] | None:
        """Return the newest state and its age, for people and programs; None before the first."""
        known = self._known
        if known is None:
            return None
        state, at = known
        return {**asdict(state), "age_s": self._clock.now().since(at) / NS_PER_S}

    def _run(self) -> None:
        while True:
            self.look()
            if self._stopping.wait(EVERY_S):
                return
