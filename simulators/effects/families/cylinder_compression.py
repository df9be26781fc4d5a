"""A cylinder that its oil pressure makes longer than its transducer says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class CylinderCompression(Effect):
    """d_s = k p, p of the column `<joint>_bar`.

    Attributes:
        mm_per_bar: k.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm_per_bar": 0.1}
    acts_at = ("prismatic",)
    mm_per_bar: float = 0.01

    def joint_change(self, body: Body) -> Floats:
        return self.mm_per_bar * body.column(f"{self.where}_bar")
