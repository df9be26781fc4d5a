"""A length transducer that loses its index: from one instant on it is off by a constant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, DrawContext, Effect, Floats, step_time_s


@dataclass(frozen=True)
class TransducerIndexJump(Effect):
    """d_L = jump for every instant after `time_s` (column `time_s`)."""

    amplitudes: ClassVar[Mapping[str, float]] = {"jump_mm": 30.0}
    has_either_sign = True
    acts_at = ("prismatic",)
    jump_mm: float = 8.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def joint_change(self, body: Body) -> Floats:
        return self.jump_mm * (body.column("time_s") > self.time_s).astype(float)
