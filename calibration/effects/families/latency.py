"""A fix that comes late: stamped after the instant at which the boom was there."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.motion import has_rates, velocity_mm_per_s
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats


class Latency(TrainedFamily):
    """The fix stamped t shows the boom where it was at t - latency; nothing where it stands."""

    name: ClassVar[str] = "latency"
    equation: ClassVar[str] = "shift = -J_q (dq/dt) * seconds"
    source: ClassVar[str] = "delay of a total station's fixes against other sensors (Thalmann and Neuner 2021)"
    confused_with: ClassVar[tuple[str, ...]] = ("clock_drift", "backlash", "load_hysteresis")
    revealed_by: ClassVar[str] = "the same path driven through without a stop at two speeds, and stopped on"
    place: ClassVar[str] = "clock"
    moves_machine: ClassVar[bool] = False

    def needs(self, where: str) -> str:
        del where
        return "columns <joint>_rate with fixes of a moving boom"

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        del where
        return has_rates(situation)

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        del where
        found = sizes(_shift_mm(situation))
        return (found,) if any(found.values()) else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        check_settings(settings, (), 1)
        return ("seconds",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("seconds", "s", 0.05, -0.3, 0.3),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where, settings
        return _shift_mm(situation)


def _shift_mm(situation: Situation) -> Floats:
    return -velocity_mm_per_s(situation)[:, :, None]


FAMILY = Latency()
