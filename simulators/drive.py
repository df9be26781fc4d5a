"""Drives the boom through a plan: from stop to stop, once or again and again."""

from __future__ import annotations

import math
from collections.abc import Sequence

from simulators.plan import Stop
from simulators.rig_simulator import RigSimulator


class PlanDriver:
    """Drives a simulated rig from stop to stop.

    Args:
        simulator: the rig; it stands at the first stop.
        stops: where to stand, and for how long.
        speed: share of the joints' greatest rates.
        repeat: begin anew after the last stop.
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
        """Return True once the last stop has ended and the plan is not repeated; begins anew where it is."""
        if now_s < self._ends_s:
            return False
        if self._repeat:
            self.start(now_s)
        return not self._repeat

    def next_deadline(self) -> float:
        """Instant at which the last stop ends, simulated seconds."""
        return self._ends_s
