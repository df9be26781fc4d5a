"""A total station with a scale error of its distances."""

from __future__ import annotations

from calibration.effects.base import Coefficient, PrismFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class StationScale(PrismFamily):
    """All coordinates are scaled about the instrument's centre: a wrong atmospheric correction, a frequency error."""

    name = "station_scale"
    equation = "shift = ppm * 1e-6 * position in the station's frame"
    source = "electronic distance meters: 1 ppm per K, or per 3.6 hPa, of atmospheric error (Rueger 1990)"
    confused_with = ("thermal_expansion", "prism_constant", "transducer_scale")
    revealed_by = "the same poses from a second set-up at a different distance, or control points"
    fixed = (Coefficient("ppm", "ppm", 10.0, -50.0, 50.0),)
    place = "station"
    moves_machine = False

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where, settings
        return 1e-6 * context.located.position_mm[:, :, None]


FAMILY = StationScale()
