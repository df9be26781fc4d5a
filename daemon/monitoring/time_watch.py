"""Monitors the computer's clock: reads its state periodically and detects the loss of its synchronisation."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from daemon.host.time_service import ClockState
from daemon.host.worker_thread import WorkerThread
from drivers.clock import NS_PER_S, Clock, Stamp

log = logging.getLogger(__name__)

EVERY_S = 60.0
STOP_S = 5.0


class TimeWatch(WorkerThread):
    """Reads the state of the computer's clock in its own thread, because an answer may take seconds.

    Only a clock that was synchronised and no longer is counts as a loss: a rig without a network never is.

    Args:
        read: returns the state.
        clock: for the times of the readings.
    """

    def __init__(self, read: Callable[[], ClockState], clock: Clock) -> None:
        super().__init__("clock", STOP_S)
        self._read, self._clock = read, clock
        self._known: tuple[ClockState, Stamp] | None = None
        self._kept: Stamp | None = None  # when it was last seen to be synchronised
        self._told = ""

    def look(self) -> None:
        """Read the state now."""
        state, now = self._read(), self._clock.now()
        if state.is_synchronized:
            self._kept = now
        self._known = state, now
        if state.error != self._told:
            self._told = state.error
            if state.error:
                log.info("the state of the computer's clock is unknown: %s", state.error)

    @property
    def state(self) -> ClockState | None:
        """The newest state; None before the first reading."""
        known = self._known
        return None if known is None else known[0]

    def lost(self) -> Stamp | None:
        """Return when the clock was last synchronised if it no longer is; None if it is, or never was."""
        state = self.state
        return self._kept if state is not None and state.is_synchronized is False else None

    def status(self) -> dict[str, Any] | None:
        """Return the newest state and its age, for `status`; None before the first reading."""
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
