"""A jack that slips: from one instant on the carrier stands otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Bend, Body, Effect, check_place


@dataclass(frozen=True)
class BaseStep(Effect):
    """After `time_s` (column `time_s`) tilts about the x and y axes of the base's frame, and z along its z axis.

    The tilts are about the base's origin.
    """

    family: ClassVar[str] = "base_step"
    size: ClassVar[tuple[str, ...]] = ("tilt_x_rad", "tilt_y_rad", "z_mm")
    where: str = "base"
    tilt_x_rad: float = 1.0e-3
    tilt_y_rad: float = 1.0e-3
    z_mm: float = 3.0
    time_s: float = 0.0

    def check(self, rig: Rig) -> None:
        del rig
        check_place(self, "base")

    def bends(self, body: Body) -> Sequence[Bend]:
        after = (body.column("time_s") > self.time_s).astype(float)[:, None]
        tilt = after * np.array([self.tilt_x_rad, self.tilt_y_rad, 0.0])
        return (Bend(0, np.zeros_like(tilt), tilt, after * np.array([0.0, 0.0, self.z_mm])),)
