"""An encoder that sits off its axis: an error that repeats k times a turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, DrawContext, Effect, Floats


@dataclass(frozen=True)
class EncoderHarmonic(Effect):
    """True angle - read angle = A cos(k theta) + B sin(k theta), theta the true angle.

    Attributes:
        cosk_rad, sink_rad: A and B.
        k: cycles per turn.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"cosk_rad": 6e-3, "sink_rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    cosk_rad: float = 1.0e-3
    sink_rad: float = 1.0e-3
    k: int = 1

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        del data
        return replace(self, k=int(rng.integers(1, 3)))

    def joint_change(self, body: Body) -> Floats:
        read = body.read[self.where]
        change = np.zeros_like(read)
        # The disc's error belongs to the shaft's true angle; the fixed point is reached to 1e-9 rad in three rounds.
        for _ in range(3):
            true = read + change
            change = self.cosk_rad * np.cos(self.k * true) + self.sink_rad * np.sin(self.k * true)
        return change
