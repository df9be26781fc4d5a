"""Two clocks that run apart: fixes come the later the longer the data goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats, hours_since


@dataclass(frozen=True)
class ClockDrift(Effect):
    """A latency of ppm * 1e-6 * the time since the first row (columns `time_s` and `<joint>_rate`).

    Attributes:
        ppm: rate by which the station's clock is slow.
        first_s: the instant at which the clocks agree; None: the earliest of the rows given.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"ppm": 50.0}
    has_either_sign = True
    acts_at = ("clock",)
    where: str = "clock"
    ppm: float = 5.0
    first_s: float | None = None

    def delay_s(self, body: Body) -> Floats:
        return self.ppm * 1e-6 * 3600.0 * hours_since(body, self.first_s)
