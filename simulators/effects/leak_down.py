"""A cylinder that leaks while it stands: its joint sinks below its encoder by a rate times the dwell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class LeakDown(Effect):
    """d_theta = -rate * time since the last motion (column `dwell_s`)."""

    family: ClassVar[str] = "leak_down"
    size: ClassVar[tuple[str, ...]] = ("rad_per_s",)
    rad_per_s: float = 1.0e-5

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        return -self.rad_per_s * body.column("dwell_s")
