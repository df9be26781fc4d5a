"""A length transducer on a wire or wheel that slips a little with every metre it travels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class TransducerCumulative(Effect):
    """d_L = k * path travelled, in m, since the first row.

    The path is the column `<joint>_travel_m` where the caller has it, else that of the readings from row to row.

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
