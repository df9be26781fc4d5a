"""A clock for tests of programs that are stopped, without a wait."""

from __future__ import annotations

from drivers.clock import NS_PER_S, Stamp, SystemClock

AWAY_S = 10.0


class StoppedClock(SystemClock):
    """The host's clock in a program that can be stopped for AWAY_S at once."""

    def __init__(self) -> None:
        super().__init__()
        self._away_ns = 0

    def stop(self) -> None:
        """As SIGSTOP and, later, SIGCONT do."""
        self._away_ns += round(AWAY_S * NS_PER_S)

    def now(self) -> Stamp:
        return super().now().shifted(self._away_ns)

    def monotonic_ns(self) -> int:
        return super().monotonic_ns() + self._away_ns
