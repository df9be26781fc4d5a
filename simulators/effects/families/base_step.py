"""A jack that slips: from one instant on the carrier stands otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, DrawContext, Effect, step_time_s


@dataclass(frozen=True)
class BaseStep(Effect):
    """After `time_s` (column `time_s`) tilts about the x and y axes of the base's frame, and z along its z axis.

    The tilts are about the base's origin.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"tilt_x_rad": 5e-3, "tilt_y_rad": 5e-3, "z_mm": 20.0}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    tilt_x_rad: float = 1.0e-3
    tilt_y_rad: float = 1.0e-3
    z_mm: float = 3.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def bends(self, body: Body) -> Sequence[Bend]:
        after = (body.column("time_s") > self.time_s).astype(float)[:, None]
        tilt = after * np.array([self.tilt_x_rad, self.tilt_y_rad, 0.0])
        return (Bend(0, np.zeros_like(tilt), tilt, after * np.array([0.0, 0.0, self.z_mm])),)
