"""A machine that grows with its temperature."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats

_COLUMN = "temperature_degC"


class ThermalExpansion(TrainedFamily):
    """All lengths grow alike, from the base's origin: the kinematics hold at the mean temperature of the training."""

    name: ClassVar[str] = "thermal_expansion"
    equation: ClassVar[str] = "all lengths * (1 + per_K * (T - mean T of the training data))"
    source: ClassVar[str] = "linear expansion of steel, 12e-6 per K +-30 % with what is not steel (EN 1993-1-1)"
    confused_with: ClassVar[tuple[str, ...]] = ("station_scale", "base_settlement", "solar_bow")
    revealed_by: ClassVar[str] = "the same far poses at another temperature, cold in the morning and warm at noon"
    place: ClassVar[str] = "boom"  # the whole machine, whatever it is
    column: ClassVar[str] = _COLUMN

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        known = self.known(situation, where)
        temperature = situation.extra(_COLUMN)[known]
        if not len(temperature) or np.ptp(temperature) == 0.0:
            return ()
        mean = float(temperature.mean())
        return ({"mean_degC": mean, **sizes(_shift_mm(situation, mean)[known])},)

    def names(self, settings: Settings) -> tuple[str, ...]:
        check_settings(settings, ("mean_degC",), 1)
        return ("per_K",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("per_K", "1/K", 12e-6, 0.0, 2.5e-5),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(situation, settings["mean_degC"])


def _shift_mm(situation: Situation, mean: float) -> Floats:
    """(n, 3, 1) mm K of growth, for the mean temperature of the training in degC."""
    warmer = np.nan_to_num(situation.extra(_COLUMN) - mean)
    return situation.to_station((warmer[:, None] * situation.located.prism_mm)[:, :, None])


FAMILY = ThermalExpansion()
