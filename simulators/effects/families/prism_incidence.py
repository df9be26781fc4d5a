"""A 360 degree prism that reads long or short by the side that it shows to the station."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Effect, Floats, Sight


@dataclass(frozen=True)
class PrismIncidence(Effect):
    """Distance error cos1 cos(psi) + sin1 sin(psi), psi the azimuth of the direction to the station.

    psi is about the z axis of the frame that the prism is fixed to, from its x axis.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"cos1_mm": 8.0, "sin1_mm": 8.0}
    has_either_sign = True
    acts_at = ("prism",)
    cos1_mm: float = 1.0
    sin1_mm: float = 1.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where != sight.prism:
            return None
        line = sight.place_mm / np.linalg.norm(sight.place_mm, axis=1)[:, None]
        back = (-line[:, None, :] @ sight.axes)[:, 0, :]  # towards the station, in the prism's frame
        psi = np.arctan2(back[:, 1], back[:, 0])
        longer = self.cos1_mm * np.cos(psi) + self.sin1_mm * np.sin(psi)
        shift: Floats = longer[:, None] * line
        return shift
