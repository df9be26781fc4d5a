"""An encoder whose scale is off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class AngleScale(Effect):
    """d_theta = scale * theta as read, from the zero of the reading; 1e-3 is 0.9 mrad at 50 deg."""

    family: ClassVar[str] = "angle_scale"
    size: ClassVar[tuple[str, ...]] = ("scale",)
    scale: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]
