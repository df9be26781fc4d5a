"""A telescope that jams in the warmth: its joint errs with temperature times extension."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig import Rig
from simulators.effects.base import Body, Effect, Floats, check_kind, warming
from simulators.effects.outside.stroke import boom_stroke


@dataclass(frozen=True)
class ThermalCross(Effect):
    """d_theta = e (T - T0) / 10 K * L / upper limit, T of the column `temperature_degC`, L the stroke as read.

    Attributes:
        rad_at_10K: e.
        at_degC: T0; None: the mean of the rows given.
    """

    family: ClassVar[str] = "thermal_cross"
    size: ClassVar[tuple[str, ...]] = ("rad_at_10K",)
    rad_at_10K: float = 1.0e-3  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def check(self, rig: Rig) -> None:
        super().check(rig)
        check_kind(self, rig, "revolute")
        if boom_stroke(rig) is None:
            raise ValueError(f"{self.family}@{self.where}: rig {rig.name!r} has no stroke")

    def joint_change(self, body: Body) -> Floats:
        stroke = boom_stroke(body.rig)
        if stroke is None:
            return np.zeros_like(body.read[self.where])
        out = body.read[stroke] / body.rig.joint(stroke).limits[1]
        change: Floats = self.rad_at_10K * warming(body, self.at_degC) / 10.0 * out
        return change
