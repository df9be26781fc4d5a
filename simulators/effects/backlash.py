"""Play between encoder and joint: the encoder lags behind the joint by half the play, on the side it came from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class Backlash(Effect):
    """d_theta = width / 2 * direction of the last motion (column `<joint>_dir`)."""

    family: ClassVar[str] = "backlash"
    size: ClassVar[tuple[str, ...]] = ("width_rad",)
    width_rad: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * body.column(f"{self.where}_dir")
