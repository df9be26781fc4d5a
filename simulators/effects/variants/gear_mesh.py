"""Teeth that mesh unevenly: an error that repeats with every tooth of a worm wheel or rack."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class GearMesh(Effect):
    """d_theta = A cos(n theta) + B sin(n theta), n cycles a turn, theta as read."""

    amplitudes: ClassVar[Mapping[str, float]] = {"cos_rad": 6e-3, "sin_rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    cos_rad: float = 1.0e-3
    sin_rad: float = 1.0e-3
    cycles: int = 9

    def joint_change(self, body: Body) -> Floats:
        angle = self.cycles * body.read[self.where]
        change: Floats = self.cos_rad * np.cos(angle) + self.sin_rad * np.sin(angle)
        return change
