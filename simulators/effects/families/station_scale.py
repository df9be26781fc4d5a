"""A distance meter with the wrong atmospheric correction: every distance is off by the same share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Effect, Floats, Sight


@dataclass(frozen=True)
class StationScale(Effect):
    """A fix is at (1 + k) times the prism's place, seen from the instrument's centre.

    Attributes:
        ppm: k * 1e6.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"ppm": 50.0}
    has_either_sign = True
    acts_at = ("station",)
    where: str = "station"
    ppm: float = 10.0

    def fix_shift_mm(self, sight: Sight) -> Floats:
        return self.ppm * 1e-6 * sight.place_mm
