"""A hose or linkage that one joint drags along another: no law of either alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind
from simulators.effects.outside.stroke import boom_stroke


@dataclass(frozen=True)
class CrossLaw(Effect):
    """d_theta = e sin(3 phi) (L / mid-stroke - 1), as read: phi the revolute joint before this one, L the stroke."""

    family: ClassVar[str] = "cross_law"
    size: ClassVar[tuple[str, ...]] = ("rad",)
    rad: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")
        if self._other(rig) is None or boom_stroke(rig) is None:
            raise ValueError(f"{self.family}@{self.where}: it takes a revolute joint before this one, and a stroke")

    def _other(self, rig: Rig) -> str | None:
        turning = [joint.name for joint in rig.joints if joint.kind == "revolute"]
        place = turning.index(self.where)
        return turning[place - 1] if place else None

    def joint_change(self, body: Body) -> Floats:
        other, stroke = self._other(body.rig), boom_stroke(body.rig)
        if other is None or stroke is None:
            return np.zeros_like(body.read[self.where])
        beside = body.read[stroke] / (sum(body.rig.joint(stroke).limits) / 2) - 1.0
        change: Floats = self.rad * np.sin(3.0 * body.read[other]) * beside
        return change
