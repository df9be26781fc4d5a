"""A machine that expands with its temperature."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_COLUMN = "temperature_degC"
_AS_IT_IS = "mounting_as_it_is"
_FORMS: tuple[Settings, ...] = ({}, {_AS_IT_IS: 1.0})


class ThermalExpansion(SizedFamily):
    """All lengths expand equally from the base's origin; the kinematics hold at the mean temperature of the training.

    The part on which a prism is mounted, such as a robot's tool, may be of a material that does not expand; this is a
    variant, which the data select.
    """

    name = "thermal_expansion"
    equation = "all lengths * (1 + per_K * (T - mean T of the training data))"
    source = "linear expansion of steel, 12e-6 per K, +-30 % due to other materials (EN 1993-1-1)"
    confused_with = ("station_scale", "base_settlement", "solar_bow")
    revealed_by = "the same far poses at different temperatures, cold in the morning and warm at noon"
    fixed = (Coefficient("per_K", "1/K", 12e-6, 0.0, 2.5e-5),)
    place = "boom"  # the whole machine, also without a boom
    column = _COLUMN

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known = self.known(context, where)
        temperature = context.extra(_COLUMN)[known]
        if not len(temperature) or np.ptp(temperature) == 0.0:
            return ()
        mean = {"mean_degC": float(temperature.mean())}
        all_of_it, links = ({**mean, **form, **sizes(_shift_mm(context, {**mean, **form})[known])} for form in _FORMS)
        return (all_of_it,) if all_of_it["size1_mm"] == links["size1_mm"] else (all_of_it, links)

    def form(self, settings: Settings) -> str:
        return "the prisms' mountings do not expand" if _AS_IT_IS in settings else ""

    def check_settings(self, settings: Settings) -> None:
        form = {name: value for name, value in settings.items() if name == _AS_IT_IS}
        if form not in _FORMS:
            raise ValueError(f"the setting {_AS_IT_IS} is not 1")
        check_sizes(settings, ("mean_degC", *form), 1)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(context, settings)


def _shift_mm(context: EffectContext, settings: Settings) -> Floats:
    """Return the displacements (n, 3, 1) per unit of expansion coefficient, mm K."""
    warmer = np.nan_to_num(context.extra(_COLUMN) - settings["mean_degC"])
    grown = _mounted_mm(context) if _AS_IT_IS in settings else context.located.prism_mm
    return context.to_station((warmer[:, None] * grown)[:, :, None])


def _mounted_mm(context: EffectContext) -> Floats:
    """Return the origins (n, 3) of the prisms' frames, in the base frame."""
    mounted_mm: Floats = context.located.frames_mm[np.arange(len(context)), context.prism_frame]
    return mounted_mm


FAMILY = ThermalExpansion()
