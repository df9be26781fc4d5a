"""Clearance in a joint that always rests on the side gravity pushes it to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class GravityFlipPlay(Effect):
    """d_theta = width / 2 * sign(torque), the torque that of the deflected posture."""

    amplitudes: ClassVar[Mapping[str, float]] = {"width_rad": 5e-3}
    needs_load = True
    acts_at = ("revolute",)
    width_rad: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * np.sign(body.torque(self.where))
