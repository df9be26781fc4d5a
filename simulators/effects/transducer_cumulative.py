"""A length transducer on a wire or wheel that slips a little with every metre it travels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class TransducerCumulative(Effect):
    """d_L = k * path travelled, in m, since the first row.

    The path is the column `<joint>_travel_m` where the caller has it, else that of the readings from row to row.

    Attributes:
        mm_per_m: k.
    """

    family: ClassVar[str] = "transducer_cumulative"
    size: ClassVar[tuple[str, ...]] = ("mm_per_m",)
    mm_per_m: float = 0.03

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "prismatic")

    def joint_change(self, body: Body) -> Floats:
        column = f"{self.where}_travel_m"
        if body.has(column):
            return self.mm_per_m * body.column(column)
        read = body.read[self.where]
        change: Floats = self.mm_per_m * np.cumsum(np.abs(np.diff(read, prepend=read[:1]))) / 1e3
        return change
