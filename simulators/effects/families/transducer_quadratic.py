"""A length transducer that is not linear: right in the middle of its stroke, off at both ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class TransducerQuadratic(Effect):
    """d_L = k (L - mid-stroke)^2, L as read in m.

    Attributes:
        mm_per_m2: k; 5 is 5.9 mm at the ends of a stroke of 2168 mm.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm_per_m2": 20.0}
    has_either_sign = True
    acts_at = ("prismatic",)
    mm_per_m2: float = 5.0

    def joint_change(self, body: Body) -> Floats:
        beside_m = (body.read[self.where] - sum(body.rig.joint(self.where).limits) / 2) / 1e3
        change: Floats = self.mm_per_m2 * beside_m**2
        return change
