"""A length transducer that loses its index: from one instant on it is off by a constant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class TransducerIndexJump(Effect):
    """d_L = jump for every instant after `time_s` (column `time_s`)."""

    family: ClassVar[str] = "transducer_index_jump"
    size: ClassVar[tuple[str, ...]] = ("jump_mm",)
    jump_mm: float = 8.0
    time_s: float = 0.0

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "prismatic")

    def joint_change(self, body: Body) -> Floats:
        return self.jump_mm * (body.column("time_s") > self.time_s).astype(float)
