"""An error of a joint that two joints decide together: hoses, cable trays and castings that pull on one another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats
from simulators.effects.unknown.surface import draw_surface


@dataclass(frozen=True)
class JointPairError(Effect):
    """True value - read value = a smooth function of two joints as read, drawn once from `seed`.

    Attributes:
        rms_rad: its root mean square over their ranges; mm at a prismatic joint: `mm_per_rad` times as much.
        seed: the same seed draws the same function of the same two joints.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rms_rad": 10e-3}
    acts_at = ("joint",)
    mm_per_rad: ClassVar[float] = 5e3
    rms_rad: float = 1.0e-3
    seed: int = 0

    def joint_change(self, body: Body) -> Floats:
        unit = 1.0 if body.rig.joint(self.where).kind == "revolute" else self.mm_per_rad
        return self.rms_rad * unit * draw_surface(body.rig, self.seed).values(body.rig, body.read)
