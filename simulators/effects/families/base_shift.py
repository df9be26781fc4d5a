"""A carrier that is pushed: from one instant on it stands elsewhere on the ground, and heads elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, DrawContext, Effect, step_time_s


@dataclass(frozen=True)
class BaseShift(Effect):
    """After `time_s` (column `time_s`) a turn about the z axis of the base's frame, and shifts along its x and y.

    The turn is about the base's origin.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_mm": 50.0, "y_mm": 50.0, "heading_rad": 10e-3}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    x_mm: float = 5.0
    y_mm: float = 5.0
    heading_rad: float = 1e-3
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def bends(self, body: Body) -> Sequence[Bend]:
        after = np.where(body.column("time_s") > self.time_s, 1.0, 0.0)
        none = np.zeros_like(after)
        heading = np.column_stack([none, none, self.heading_rad * after])
        shift_mm = np.column_stack([self.x_mm * after, self.y_mm * after, none])
        return (Bend(0, np.zeros_like(heading), heading, shift_mm),)
