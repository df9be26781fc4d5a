"""A fix that comes late: stamped t, it shows the machine at t - latency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_place


@dataclass(frozen=True)
class Latency(Effect):
    """The machine at the fix is at readings - rate * latency, the rate of the columns `<joint>_rate`."""

    family: ClassVar[str] = "latency"
    size: ClassVar[tuple[str, ...]] = ("seconds",)
    where: str = "clock"
    seconds: float = 0.05

    def check(self, rig: Rig) -> None:
        del rig
        check_place(self, "clock")

    def delay_s(self, body: Body) -> Floats:
        return np.full_like(body.column(f"{body.rig.joint_names[0]}_rate"), self.seconds)
