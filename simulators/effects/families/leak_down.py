"""A cylinder that leaks while it stands: its joint sinks below its encoder by a rate times the dwell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class LeakDown(Effect):
    """d_theta = -rate * time since the last motion (column `dwell_s`)."""

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_s": 5e-5}
    needs_load = True
    acts_at = ("revolute",)
    rad_per_s: float = 1.0e-5

    def joint_change(self, body: Body) -> Floats:
        return -self.rad_per_s * body.column("dwell_s")
