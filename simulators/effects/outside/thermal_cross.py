"""A telescope that jams in the warmth: its joint errs with temperature times extension."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats, boom_stroke, warming


@dataclass(frozen=True)
class ThermalCross(Effect):
    """d_theta = e (T - T0) / 10 K * L / upper limit, T of the column `temperature_degC`, L the stroke as read.

    Attributes:
        rad_at_10K: e.
        at_degC: T0; None: the mean of the rows given.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_at_10K": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    rad_at_10K: float = 1.0e-3  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def check(self, rig: Rig) -> None:
        super().check(rig)
        boom_stroke(rig)

    def joint_change(self, body: Body) -> Floats:
        stroke = boom_stroke(body.rig)
        out = body.read[stroke] / body.rig.joint(stroke).limits[1]
        change: Floats = self.rad_at_10K * warming(body, self.at_degC) / 10.0 * out
        return change
