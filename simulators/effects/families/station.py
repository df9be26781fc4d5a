"""Errors of the station and of its clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats, Sight, hours_since


@dataclass(frozen=True)
class StationScale(Effect):
    """A distance meter with the wrong atmospheric correction: every distance is wrong by the same share.

    A fix is at (1 + k) times the prism's position relative to the instrument's centre.

    Attributes:
        ppm: k * 1e6.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"ppm": 50.0}
    has_either_sign = True
    acts_at = ("station",)
    where: str = "station"
    ppm: float = 10.0

    def fix_shift_mm(self, sight: Sight) -> Floats:
        return self.ppm * 1e-6 * sight.place_mm


@dataclass(frozen=True)
class Latency(Effect):
    """A late fix: with stamp t, it shows the machine at t - latency.

    At the fix the joints are at readings - rate * latency, with the rates from the columns `<joint>_rate`.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"seconds": 0.3}
    acts_at = ("clock",)
    where: str = "clock"
    seconds: float = 0.05

    def delay_s(self, body: Body) -> Floats:
        return np.full_like(body.column(f"{body.rig.joint_names[0]}_rate"), self.seconds)


@dataclass(frozen=True)
class ClockDrift(Effect):
    """Two clocks with different rates: the latency of the fixes grows over the data.

    A latency of ppm * 1e-6 * the time since the first row (columns `time_s` and `<joint>_rate`).

    Attributes:
        ppm: rate by which the station's clock is slow.
        first_s: time at which the clocks agree; None for the earliest time of the given rows.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"ppm": 50.0}
    has_either_sign = True
    acts_at = ("clock",)
    where: str = "clock"
    ppm: float = 5.0
    first_s: float | None = None

    def delay_s(self, body: Body) -> Floats:
        return self.ppm * 1e-6 * 3600.0 * hours_since(body, self.first_s)
