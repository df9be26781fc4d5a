"""A carrier on springs: it leans to where its boom weighs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, Effect


@dataclass(frozen=True)
class BaseCompliance(Effect):
    """Tilt about the base's origin, about its x and y axes, in proportion to the moment of all weights about each.

    Attributes:
        x_rad_per_Nm, y_rad_per_Nm: of the springs.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_rad_per_Nm": 15e-3, "y_rad_per_Nm": 15e-3}
    bounded_at = "largest_load"
    acts_at = ("base",)
    where: str = "base"
    x_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    y_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def bends(self, body: Body) -> Sequence[Bend]:
        moment = body.overturning_newton_m()
        tilt = np.array([self.x_rad_per_Nm, self.y_rad_per_Nm, 0.0]) * moment
        return (Bend(0, np.zeros_like(tilt), tilt, np.zeros_like(tilt)),)
