"""A link that tilts in its bearing: what pulls it sideways turns it out of its joint's plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, Effect, first_turned


@dataclass(frozen=True)
class LateralCompliance(Effect):
    """A joint's link, and all beyond, turns by compliance times the part of the weights' moment across its axis.

    Attributes:
        where: a revolute joint, not the first that turns.
        compliance_rad_per_Nm: the same about both axes across the joint's.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"compliance_rad_per_Nm": 20e-3}
    bounded_at = "largest_moment"
    acts_at = ("revolute",)
    compliance_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def check(self, rig: Rig) -> None:
        super().check(rig)
        turned = {number for number, what, _, _ in rig.couplings() if what == "theta"}
        row = first_turned(rig).get(self.where)
        if not rig.masses or row is None or not turned & set(rig.path(row)[:-1]):
            raise ValueError(f"{self.family}@{self.where}: it acts at joints beyond another that turns, under weights")

    def moment_row(self, rig: Rig) -> int:
        return first_turned(rig)[self.where]

    def bends(self, body: Body) -> Sequence[Bend]:
        row = self.moment_row(body.rig)
        turning = body.turning(row)
        # z x (M x z) is M without its part along z.
        across = np.cross(turning.axis, np.cross(turning.moment_newton_m, turning.axis))
        tilt = self.compliance_rad_per_Nm * across
        return (Bend(row, turning.straight_mm, tilt, np.zeros_like(tilt)),)
