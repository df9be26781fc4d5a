"""Teeth that mesh unevenly: an error that repeats with every tooth of a worm wheel or rack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class GearMesh(Effect):
    """d_theta = A cos(n theta) + B sin(n theta), n cycles a turn, theta as read."""

    family: ClassVar[str] = "gear_mesh"
    size: ClassVar[tuple[str, ...]] = ("cos_rad", "sin_rad")
    cos_rad: float = 1.0e-3
    sin_rad: float = 1.0e-3
    cycles: int = 9

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        angle = self.cycles * body.read[self.where]
        change: Floats = self.cos_rad * np.cos(angle) + self.sin_rad * np.sin(angle)
        return change
