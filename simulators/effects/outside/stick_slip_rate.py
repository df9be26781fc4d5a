"""A joint that is dragged back while it moves, at once and by much the same whatever its speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class StickSlipRate(Effect):
    """d_theta = e tanh(rate / v), the rate of the column `<joint>_rate`; nothing at rest.

    Attributes:
        rad: e.
        deg_per_s: v.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad": 6e-3}
    acts_at = ("revolute",)
    positive = ("deg_per_s",)
    rad: float = 1.5e-3
    deg_per_s: float = 0.15

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad * np.tanh(body.column(f"{self.where}_rate") / self.deg_per_s)
        return change
