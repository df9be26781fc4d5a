"""A total station whose distances are off in proportion."""

from __future__ import annotations

from typing import ClassVar

from calibration.effects.base import Coefficient, PrismFamily, Settings, Situation, refuse_settings
from calibration.observations import Floats


class StationScale(PrismFamily):
    """All coordinates grow from the instrument's centre: a wrong atmosphere, a frequency that is off."""

    name: ClassVar[str] = "station_scale"
    equation: ClassVar[str] = "shift = ppm * 1e-6 * position in the station's frame"
    source: ClassVar[str] = (
        "electronic distance meters: 1 ppm per K, or per 3.6 hPa, of a wrong atmosphere (Rueger 1990)"
    )
    confused_with: ClassVar[tuple[str, ...]] = ("thermal_expansion", "prism_constant", "transducer_scale")
    revealed_by: ClassVar[str] = "the same poses from a second set-up at another distance, or control points"
    place: ClassVar[str] = "station"
    moves_machine: ClassVar[bool] = False

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("ppm",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("ppm", "ppm", 10.0, -50.0, 50.0),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where, settings
        return 1e-6 * situation.located.position_mm[:, :, None]


FAMILY = StationScale()
