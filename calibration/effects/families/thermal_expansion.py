"""A machine that grows with its temperature."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats

_COLUMN = "temperature_degC"
_AS_IT_IS = "mounting_as_it_is"
_FORMS: tuple[Settings, ...] = ({}, {_AS_IT_IS: 1.0})


class ThermalExpansion(TrainedFamily):
    """All lengths grow alike, from the base's origin: the kinematics hold at the mean temperature of the training.

    What a prism is mounted on, such as a robot's tool, may be of a material that does not grow; the data choose.
    """

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
        mean = {"mean_degC": float(temperature.mean())}
        all_of_it, links = ({**mean, **form, **sizes(_shift_mm(situation, {**mean, **form})[known])} for form in _FORMS)
        return (all_of_it,) if all_of_it["size1_mm"] == links["size1_mm"] else (all_of_it, links)

    def form(self, settings: Settings) -> str:
        return "the prisms' mountings do not grow" if _AS_IT_IS in settings else ""

    def names(self, settings: Settings) -> tuple[str, ...]:
        form = {name: value for name, value in settings.items() if name == _AS_IT_IS}
        if form not in _FORMS:
            raise ValueError(f"the setting {_AS_IT_IS} is not 1")
        check_settings(settings, ("mean_degC", *form), 1)
        return ("per_K",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("per_K", "1/K", 12e-6, 0.0, 2.5e-5),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(situation, settings)


def _shift_mm(situation: Situation, settings: Settings) -> Floats:
    """(n, 3, 1) mm K of growth."""
    warmer = np.nan_to_num(situation.extra(_COLUMN) - settings["mean_degC"])
    grown = _mounted_mm(situation) if _AS_IT_IS in settings else situation.located.prism_mm
    return situation.to_station((warmer[:, None] * grown)[:, :, None])


def _mounted_mm(situation: Situation) -> Floats:
    """(n, 3) where the frames of the prisms are, in the base frame."""
    mounted_mm: Floats = situation.located.frames_mm[np.arange(len(situation)), situation.prism_frame]
    return mounted_mm


FAMILY = ThermalExpansion()
