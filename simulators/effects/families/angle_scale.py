"""An encoder whose scale is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class AngleScale(Effect):
    """d_theta = scale * theta as read, from the zero of the reading; 1e-3 is 0.9 mrad at 50 deg."""

    amplitudes: ClassVar[Mapping[str, float]] = {"scale": 5e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    scale: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]
