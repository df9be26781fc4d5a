"""Errors of length transducers and of the cylinders on which they are mounted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, DrawContext, Effect, Floats, step_time_s


@dataclass(frozen=True)
class TransducerScale(Effect):
    """A length transducer with a wrong scale.

    d_L = scale * L as read; 2e-3 is 4 mm at the end of a 2 m stroke.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"scale": 1e-2}
    has_either_sign = True
    acts_at = ("prismatic",)
    scale: float = 2.0e-3

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]


@dataclass(frozen=True)
class TransducerQuadratic(Effect):
    """A length transducer that is not linear: right in the middle of its stroke, wrong at both ends.

    d_L = k (L - mid-stroke)^2, L as read in m.

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


@dataclass(frozen=True)
class TransducerIndexJump(Effect):
    """A length transducer that loses its index: from one instant on it is wrong by a constant.

    d_L = jump at all times after `time_s` (column `time_s`).
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"jump_mm": 30.0}
    has_either_sign = True
    acts_at = ("prismatic",)
    jump_mm: float = 8.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def joint_change(self, body: Body) -> Floats:
        return self.jump_mm * (body.column("time_s") > self.time_s).astype(float)


@dataclass(frozen=True)
class TransducerCumulative(Effect):
    """A length transducer on a wire or wheel that slips a little with every metre of travel.

    d_L = k * path travelled, in m, since the first row.

    The path is the column `<joint>_travel_m` if the caller provides it, else the sum of the changes from row to row.

    Attributes:
        mm_per_m: k.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm_per_m": 0.3}
    has_either_sign = True
    acts_at = ("prismatic",)
    mm_per_m: float = 0.03

    def joint_change(self, body: Body) -> Floats:
        column = f"{self.where}_travel_m"
        if body.has(column):
            return self.mm_per_m * body.column(column)
        read = body.read[self.where]
        change: Floats = self.mm_per_m * np.cumsum(np.abs(np.diff(read, prepend=read[:1]))) / 1e3
        return change


@dataclass(frozen=True)
class CylinderCompression(Effect):
    """A cylinder that its oil pressure makes longer than its transducer reads.

    d_s = k p, p the column `<joint>_bar`.

    Attributes:
        mm_per_bar: k.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm_per_bar": 0.1}
    acts_at = ("prismatic",)
    mm_per_bar: float = 0.01

    def joint_change(self, body: Body) -> Floats:
        return self.mm_per_bar * body.column(f"{self.where}_bar")
