"""A boom that twists: what hangs beside its axis turns its tip, the more the longer it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, BoomEffect, boom_row


@dataclass(frozen=True)
class TwistByReach(BoomEffect):
    """Twist = moment about the boom's axis * length / (G J); everything from the boom's tip on turns.

    Attributes:
        flexibility_per_Nm2: 1 / (G J), of the torsional stiffness.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"flexibility_per_Nm2": 100.0}
    bounded_at = "full_reach"
    flexibility_per_Nm2: float = 1e-7  # noqa: N815 - the unit is N m^2

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam = body.beam(row)
        twist = self.flexibility_per_Nm2 * np.sum(beam.moment_newton_m * beam.axis, axis=1) * beam.length_m
        return (Bend(row, beam.tip_mm, twist[:, None] * beam.axis, np.zeros_like(beam.axis)),)
