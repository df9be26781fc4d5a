"""A joint that is dragged back while it moves, at once and by much the same whatever its speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class StickSlipRate(Effect):
    """d_theta = e tanh(rate / v), the rate of the column `<joint>_rate`; nothing at rest.

    Attributes:
        rad: e.
        deg_per_s: v.
    """

    family: ClassVar[str] = "stick_slip_rate"
    size: ClassVar[tuple[str, ...]] = ("rad",)
    rad: float = 1.5e-3
    deg_per_s: float = 0.15

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")
        if self.deg_per_s <= 0.0:
            raise ValueError(f"{self.family}@{self.where}: deg_per_s must be positive, not {self.deg_per_s:g}")

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad * np.tanh(body.column(f"{self.where}_rate") / self.deg_per_s)
        return change
