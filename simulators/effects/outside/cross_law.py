"""A hose or linkage that one joint drags along another: no law of either alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats, boom_stroke


@dataclass(frozen=True)
class CrossLaw(Effect):
    """d_theta = e sin(3 phi) (L / mid-stroke - 1), as read: phi the revolute joint before this one, L the stroke."""

    amplitudes: ClassVar[Mapping[str, float]] = {"rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    rad: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        boom_stroke(rig)
        self._joint_before(rig)

    def _joint_before(self, rig: Rig) -> str:
        turning = [joint.name for joint in rig.joints if joint.kind == "revolute"]
        place = turning.index(self.where)
        if place == 0:
            raise ValueError(f"{self.family}@{self.where}: there is no revolute joint before this one")
        return turning[place - 1]

    def joint_change(self, body: Body) -> Floats:
        other, stroke = self._joint_before(body.rig), boom_stroke(body.rig)
        beside = body.read[stroke] / (sum(body.rig.joint(stroke).limits) / 2) - 1.0
        change: Floats = self.rad * np.sin(3.0 * body.read[other]) * beside
        return change
