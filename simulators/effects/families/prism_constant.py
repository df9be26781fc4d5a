"""A prism whose constant is set wrong: every distance to it is off by the same length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Effect, Floats, Sight


@dataclass(frozen=True)
class PrismConstant(Effect):
    """A fix is `mm` further from the station than the prism, along the line of sight.

    At `station` it concerns all prisms, else the prism of that name.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm": 40.0}
    has_either_sign = True
    acts_at = ("station", "prism")
    where: str = "station"
    mm: float = 3.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where not in ("station", sight.prism):
            return None
        range_mm = np.linalg.norm(sight.place_mm, axis=1)[:, None]
        shift: Floats = self.mm * sight.place_mm / range_mm
        return shift
