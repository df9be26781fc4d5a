"""A cylinder that its oil pressure makes longer than its transducer says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class CylinderCompression(Effect):
    """d_s = k p, p of the column `<joint>_bar`.

    Attributes:
        mm_per_bar: k.
    """

    family: ClassVar[str] = "cylinder_compression"
    size: ClassVar[tuple[str, ...]] = ("mm_per_bar",)
    mm_per_bar: float = 0.01

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "prismatic")

    def joint_change(self, body: Body) -> Floats:
        return self.mm_per_bar * body.column(f"{self.where}_bar")
