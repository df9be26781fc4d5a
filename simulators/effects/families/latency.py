"""A fix that comes late: stamped t, it shows the machine at t - latency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class Latency(Effect):
    """The machine at the fix is at readings - rate * latency, the rate of the columns `<joint>_rate`."""

    amplitudes: ClassVar[Mapping[str, float]] = {"seconds": 0.3}
    acts_at = ("clock",)
    where: str = "clock"
    seconds: float = 0.05

    def delay_s(self, body: Body) -> Floats:
        return np.full_like(body.column(f"{body.rig.joint_names[0]}_rate"), self.seconds)
