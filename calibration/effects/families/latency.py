"""A fix whose timestamp is later than the instant of the measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class Latency(SizedFamily):
    """A fix with timestamp t shows the boom at t - latency; no effect while the boom stands still."""

    name = "latency"
    equation = "shift = -J_q (dq/dt) * seconds"
    source = "delay of a total station's fixes relative to other sensors (Thalmann and Neuner 2021)"
    confused_with = ("clock_drift", "backlash", "load_hysteresis")
    revealed_by = "the same path driven without a stop at two speeds, and with stops"
    fixed = (Coefficient("seconds", "s", 0.05, -0.3, 0.3),)
    place = "clock"
    moves_machine = False

    def needs(self, where: str) -> str:
        del where
        return "columns <joint>_rate with fixes of a moving boom"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        del where
        return context.has_rates

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        del where
        found = sizes(_shift_mm(context))
        return (found,) if any(found.values()) else ()

    def check_settings(self, settings: Settings) -> None:
        check_sizes(settings, (), 1)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where, settings
        return _shift_mm(context)


def _shift_mm(context: EffectContext) -> Floats:
    return -context.velocity_mm_per_s[:, :, None]


FAMILY = Latency()
