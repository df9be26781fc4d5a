"""A joint that goes on giving way under its load, quickly at first: hoses, seals and rubber."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class Creep(Effect):
    """d_theta = c torque log(1 + dwell / tau), dwell of the column `dwell_s`, the torque that of the deflected posture.

    Attributes:
        rad_per_Nm: c.
        tau_s: tau.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    positive = ("tau_s",)
    rad_per_Nm: float = 2e-9  # noqa: N815 - the unit is N m
    tau_s: float = 10.0

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad_per_Nm * body.torque(self.where) * np.log1p(body.column("dwell_s") / self.tau_s)
        return change
