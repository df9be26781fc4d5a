"""A joint that goes on giving way under its load, quickly at first: hoses, seals and rubber."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class Creep(Effect):
    """d_theta = c torque log(1 + dwell / tau), dwell of the column `dwell_s`, the torque that of the deflected posture.

    Attributes:
        rad_per_Nm: c.
        tau_s: tau.
    """

    family: ClassVar[str] = "creep"
    size: ClassVar[tuple[str, ...]] = ("rad_per_Nm",)
    rad_per_Nm: float = 2e-9  # noqa: N815 - the unit is N m
    tau_s: float = 10.0

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")
        if self.tau_s <= 0.0:
            raise ValueError(f"{self.family}@{self.where}: tau_s must be positive, not {self.tau_s:g}")

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad_per_Nm * body.torque(self.where) * np.log1p(body.column("dwell_s") / self.tau_s)
        return change
