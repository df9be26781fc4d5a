"""Ground that gives way: the carrier sinks and tilts steadily."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, Effect, hours_since


@dataclass(frozen=True)
class BaseSettlement(Effect):
    """Tilts about the x and y axes of the base's frame through its origin, and z along its z axis, growing with time.

    Time is that of the column `time_s`.

    Attributes:
        tilt_x_rad_per_h, tilt_y_rad_per_h, z_mm_per_h: the rates.
        first_s: the instant from which it counts; None: the earliest of the rows given.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"tilt_x_rad_per_h": 1e-3, "tilt_y_rad_per_h": 1e-3, "z_mm_per_h": 5.0}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    tilt_x_rad_per_h: float = 0.2e-3
    tilt_y_rad_per_h: float = 0.2e-3
    z_mm_per_h: float = 1.0
    first_s: float | None = None

    def bends(self, body: Body) -> Sequence[Bend]:
        hours = hours_since(body, self.first_s)[:, None]
        tilt = hours * np.array([self.tilt_x_rad_per_h, self.tilt_y_rad_per_h, 0.0])
        return (Bend(0, np.zeros_like(tilt), tilt, hours * np.array([0.0, 0.0, self.z_mm_per_h])),)
