"""A length transducer whose scale is off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind


@dataclass(frozen=True)
class TransducerScale(Effect):
    """d_L = scale * L as read; 2e-3 is 4 mm at the end of a 2 m stroke."""

    family: ClassVar[str] = "transducer_scale"
    size: ClassVar[tuple[str, ...]] = ("scale",)
    scale: float = 2.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "prismatic")

    def joint_change(self, body: Body) -> Floats:
        return self.scale * body.read[self.where]
