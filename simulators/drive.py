"""Driving the boom through a plan, from stop to stop, once or repeatedly."""

from __future__ import annotations

import math
from collections.abc import Sequence

from simulators.plan import Stop
from simulators.rig_simulator import RigSimulator


class PlanDriver:
    """Drives a simulated rig from stop to stop.

    Args:
        simulator: the rig; it stands at the first stop.
        stops: poses, and how long to stand at each.
        speed: share of the joints' maximum rates.
        repeat: start again after the last stop.
    """

    def __init__(self, simulator: RigSimulator, stops: Sequence[Stop], *, speed: float, repeat: bool) -> None:
        self._simulator, self._stops, self._speed, self._repeat = simulator, stops, speed, repeat
        self._ends_s = -math.inf

    def start(self, now_s: float) -> None:
        """Begin with the first stop."""
        for pose, stand_s in self._stops:
            arrival_s = self._simulator.move(pose, now_s, speed=self._speed, dwell_s=stand_s)
            self._ends_s = arrival_s + stand_s

    def is_over(self, now_s: float) -> bool:
        """Return True after the last stop of a plan that is not repeated; restart a plan that is repeated."""
        if now_s < self._ends_s:
            return False
        if self._repeat:
            self.start(now_s)
        return not self._repeat

    def next_deadline(self) -> float:
        """Return the instant at which the last stop ends, in simulated seconds."""
        return self._ends_s
