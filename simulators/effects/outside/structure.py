"""Structural deformations that are in no library: boom, carrier and a prism's mast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Bend, Body, BoomEffect, Effect, Floats, Sight, boom_row


@dataclass(frozen=True)
class TwistByReach(BoomEffect):
    """A boom that twists: an eccentric load rotates its tip, more so the longer the boom is.

    Twist = moment about the boom's axis * length / (G J); everything from the boom's tip on rotates.

    Attributes:
        flexibility_per_Nm2: 1 / (G J), the inverse of the torsional stiffness.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"flexibility_per_Nm2": 100.0}
    bounded_at = "full_reach"
    flexibility_per_Nm2: float = 1e-7  # noqa: N815 - the unit is N m^2

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam = body.beam(row)
        twist = self.flexibility_per_Nm2 * np.sum(beam.moment_newton_m * beam.axis, axis=1) * beam.length_m
        return (Bend(row, beam.tip_mm, twist[:, None] * beam.axis, np.zeros_like(beam.axis)),)


@dataclass(frozen=True)
class BaseRocking(Effect):
    """A carrier that rocks on its jacks: it leans to the side that the boom loads.

    Tilt about the base's origin by c times the level moment of all weights about it.

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


@dataclass(frozen=True)
class PrismMastBend(Effect):
    """A prism on a slender mast: gravity bends the mast to one side as the frame under it turns.

    The prism is displaced by k times the part of gravity's direction that is perpendicular to its mast.

    The mast is along the z axis of the frame to which the prism is fixed.

    Attributes:
        mm: k, for a level mast.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm": 15.0}
    acts_at = ("prism",)
    mm: float = 3.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where != sight.prism:
            return None
        mast, down = sight.axes[:, :, 2], np.array([0.0, 0.0, -1.0])
        shift: Floats = self.mm * (down - (mast @ down)[:, None] * mast)
        return shift
