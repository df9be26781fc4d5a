"""Two clocks that run apart: the station's and that of the joints."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.elapsed import ELAPSED_SETTINGS, check_elapsed, elapsed_s, elapsed_settings
from calibration.effects.motion import has_rates, velocity_mm_per_s
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats


class ClockDrift(TrainedFamily):
    """A latency that grows steadily from the first row of the training on; nothing where the boom stands."""

    name: ClassVar[str] = "clock_drift"
    equation: ClassVar[str] = "shift = -J_q (dq/dt) * ppm * 1e-6 * (t - t_first)"
    source: ClassVar[str] = "frequency error of quartz clocks that nothing disciplines: some ppm, 50 at the worst"
    confused_with: ClassVar[tuple[str, ...]] = ("latency",)
    revealed_by: ClassVar[str] = "fixes of a moving boom at the start and at the end of a long session"
    place: ClassVar[str] = "clock"
    moves_machine: ClassVar[bool] = False

    def needs(self, where: str) -> str:
        del where
        return "the column time_s and columns <joint>_rate with fixes of a moving boom"

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        del where
        return has_rates(situation) & np.isfinite(situation.extra("time_s"))

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        known = self.known(situation, where)
        elapsed = elapsed_settings(situation.extra("time_s")[known])
        if elapsed is None:
            return ()
        found = sizes(_shift_mm(situation, elapsed)[known])
        return ({**elapsed, **found},) if any(found.values()) else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        check_settings(settings, ELAPSED_SETTINGS, 1)
        check_elapsed(settings)
        return ("ppm",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("ppm", "ppm", 5.0, -50.0, 50.0),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(situation, settings)


def _shift_mm(situation: Situation, elapsed: Settings) -> Floats:
    late_s = 1e-6 * elapsed_s(situation, elapsed)
    return -late_s[:, None, None] * velocity_mm_per_s(situation)[:, :, None]


FAMILY = ClockDrift()
