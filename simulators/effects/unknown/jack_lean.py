"""A carrier on jacks of which those on one side are softer: it leans to where its boom weighs on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, Effect


@dataclass(frozen=True)
class JackLean(Effect):
    """Tilt about the base's origin: about its x axis by c_x (M_x + s |M_x|), likewise about y; M moves the weights.

    Attributes:
        x_rad_per_Nm, y_rad_per_Nm: c.
        softer: s, from -1 to 1.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_rad_per_Nm": 5e-3, "y_rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    acts_at = ("base",)
    where: str = "base"
    x_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    y_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    softer: float = 0.5

    def bends(self, body: Body) -> Sequence[Bend]:
        moment = body.overturning_newton_m()
        tilt = np.array([self.x_rad_per_Nm, self.y_rad_per_Nm, 0.0]) * (moment + self.softer * np.abs(moment))
        return (Bend(0, np.zeros_like(tilt), tilt, np.zeros_like(tilt)),)
