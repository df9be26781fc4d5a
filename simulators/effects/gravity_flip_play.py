"""Clearance in a joint that always rests on the side gravity pushes it to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class GravityFlipPlay(Effect):
    """d_theta = width / 2 * sign(torque), the torque that of the deflected posture."""

    family: ClassVar[str] = "gravity_flip_play"
    size: ClassVar[tuple[str, ...]] = ("width_rad",)
    width_rad: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * np.sign(body.torque(self.where))
