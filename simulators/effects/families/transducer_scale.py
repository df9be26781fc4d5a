"""A length transducer whose scale is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class TransducerScale(Effect):
    """d_L = scale * L as read; 2e-3 is 4 mm at the end of a 2 m stroke."""

    amplitudes: ClassVar[Mapping[str, float]] = {"scale": 1e-2}
    has_either_sign = True
    acts_at = ("prismatic",)
    scale: float = 2.0e-3

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]
