"""A carrier that rocks on its jacks: it leans to the side that the boom weighs on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, Effect


@dataclass(frozen=True)
class BaseRocking(Effect):
    """Tilt about the base's origin by c times the level moment of all weights about it.

    Attributes:
        rad_per_Nm: c.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    acts_at = ("base",)
    where: str = "base"
    rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        if not rig.masses:
            raise ValueError(f"{self.family}: rig {rig.name!r} has no masses")

    def bends(self, body: Body) -> Sequence[Bend]:
        tilt = self.rad_per_Nm * body.overturning_newton_m()
        return (Bend(0, np.zeros_like(tilt), tilt, np.zeros_like(tilt)),)
