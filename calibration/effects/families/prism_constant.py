"""A prism constant that differs from the station's setting."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig

_SHARED = "station"
_USUAL_MM = 30.0  # size of a mix-up: usual constants of manufacturers are 0, 30 and 34.4 mm
_USUAL_ODDS = 0.2


class PrismConstant(PrismFamily):
    """A constant distance error of one prism, or of all prisms if the station has the wrong setting.

    The error is small, or it is the difference of two manufacturers' constants: the variant with `sigma_mm`.
    """

    name = "prism_constant"
    equation = "shift = mm * (unit vector from the station to the prism)"
    source = "additive constant of reflectors (ISO 17123-4); usual values of manufacturers are 0, 30 and 34.4 mm"
    confused_with = ("prism_incidence", "station_scale")
    revealed_by = "the same poses from a second set-up that sees the prism from a different side"
    moves_machine = False

    def places(self, rig: Rig) -> tuple[str, ...]:
        return (*rig.prism_names, _SHARED) if len(rig.prisms) > 1 else rig.prism_names

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        seen = np.unique(context.data.prism)
        # With a single prism in the data, its own constant and the shared one are the same.
        possible = len(seen) > 1 if where == _SHARED else context.rig.prism_names.index(where) in seen
        return ({}, {"sigma_mm": _USUAL_MM}) if possible else ()

    def odds(self, settings: Settings) -> float:
        return _USUAL_ODDS if settings else 1.0

    def names(self, settings: Settings) -> tuple[str, ...]:
        if settings and (set(settings) != {"sigma_mm"} or settings["sigma_mm"] <= 0.0):
            raise ValueError("the only setting is sigma_mm, above 0")
        return ("mm",)

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del context, where
        return (Coefficient("mm", "mm", settings.get("sigma_mm", 3.0), -40.0, 40.0),)

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        away = context.line_of_sight
        if where != _SHARED:
            away = away * context.rows_of_prism(where)[:, None]
        return away[:, :, None]


FAMILY = PrismConstant()
