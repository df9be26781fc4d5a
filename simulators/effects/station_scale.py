"""A distance meter with the wrong atmospheric correction: every distance is off by the same share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Effect, Floats, Sight, check_place


@dataclass(frozen=True)
class StationScale(Effect):
    """A fix is at (1 + k) times the prism's place, seen from the instrument's centre.

    Attributes:
        ppm: k * 1e6.
    """

    family: ClassVar[str] = "station_scale"
    size: ClassVar[tuple[str, ...]] = ("ppm",)
    where: str = "station"
    ppm: float = 10.0

    def check(self, rig: Rig) -> None:
        del rig
        check_place(self, "station")

    def fix_shift_mm(self, sight: Sight) -> Floats:
        return self.ppm * 1e-6 * sight.place_mm
