"""Play between encoder and joint: the encoder lags behind the joint by half the play, on the side it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats


@dataclass(frozen=True)
class Backlash(Effect):
    """d_theta = width / 2 * direction of the last motion (column `<joint>_dir`)."""

    amplitudes: ClassVar[Mapping[str, float]] = {"width_rad": 5e-3}
    acts_at = ("revolute",)
    width_rad: float = 1.0e-3

    def joint_change(self, body: Body) -> Floats:
        return 0.5 * self.width_rad * body.column(f"{self.where}_dir")
