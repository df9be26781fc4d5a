"""Drift between the station's clock and the clock of the joint readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.effects.timing import DRIFT_SETTINGS, check_drift, drift_settings, elapsed_s
from calibration.observations import Floats


class ClockDrift(SizedFamily):
    """A latency that grows linearly from the first training row on; no effect while the boom stands still."""

    name = "clock_drift"
    equation = "shift = -J_q (dq/dt) * ppm * 1e-6 * (t - t_first)"
    source = "frequency error of free-running quartz clocks: a few ppm, at most 50"
    confused_with = ("latency",)
    revealed_by = "fixes of a moving boom at the start and at the end of a long session"
    fixed = (Coefficient("ppm", "ppm", 5.0, -50.0, 50.0),)
    place = "clock"
    moves_machine = False

    def needs(self, where: str) -> str:
        del where
        return "the column time_s and columns <joint>_rate with fixes of a moving boom"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        del where
        return context.has_rates & np.isfinite(context.extra("time_s"))

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known = self.known(context, where)
        elapsed = drift_settings(context.extra("time_s")[known])
        if elapsed is None:
            return ()
        found = sizes(_shift_mm(context, elapsed)[known])
        return ({**elapsed, **found},) if any(found.values()) else ()

    def check_settings(self, settings: Settings) -> None:
        check_sizes(settings, DRIFT_SETTINGS, 1)
        check_drift(settings)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(context, settings)


def _shift_mm(context: EffectContext, elapsed: Settings) -> Floats:
    late_s = 1e-6 * elapsed_s(context, elapsed)
    return -late_s[:, None, None] * context.velocity_mm_per_s[:, :, None]


FAMILY = ClockDrift()
