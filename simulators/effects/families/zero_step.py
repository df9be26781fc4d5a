"""An encoder that slips on its shaft: from one instant on the joint's zero is another one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, DrawContext, Effect, Floats, step_time_s


@dataclass(frozen=True)
class ZeroStep(Effect):
    """d_theta = jump for every instant after `time_s` (column `time_s`)."""

    amplitudes: ClassVar[Mapping[str, float]] = {"jump_rad": 35e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    jump_rad: float = 2e-3
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def joint_change(self, body: Body) -> Floats:
        return np.where(body.column("time_s") > self.time_s, self.jump_rad, 0.0)
