"""A prism that sits otherwise in its seat from one instant on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import DrawContext, Effect, Floats, Sight, step_time_s


@dataclass(frozen=True)
class PrismSeatStep(Effect):
    """After `time_s` (column `time_s`) the prism is off by a vector along the axes of the frame that it is fixed to."""

    amplitudes: ClassVar[Mapping[str, float]] = {"x_mm": 30.0, "y_mm": 30.0, "z_mm": 30.0}
    has_either_sign = True
    acts_at = ("prism",)
    x_mm: float = 3.0
    y_mm: float = 3.0
    z_mm: float = 3.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if sight.prism != self.where:
            return None
        along = np.array([self.x_mm, self.y_mm, self.z_mm])
        after = sight.column("time_s") > self.time_s
        return np.where(after[:, None], sight.axes @ along, 0.0)
