"""Real time that several steps share, whatever the rig's clock does."""

from __future__ import annotations

from drivers.clock import NS_PER_S, SystemClock


class TimeBudget:
    """Time that runs from the moment this is made.

    Args:
        seconds: real ones.
    """

    def __init__(self, seconds: float) -> None:
        self._clock = SystemClock()
        self._ends_ns = self._clock.monotonic_ns() + round(seconds * NS_PER_S)

    @property
    def left_s(self) -> float:
        """What is left of it, never negative: the time-out to give to a join or a wait."""
        return max(self._ends_ns - self._clock.monotonic_ns(), 0) / NS_PER_S

    @property
    def is_over(self) -> bool:
        """True when nothing is left."""
        return self.left_s == 0.0
