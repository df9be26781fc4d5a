"""A boom that bends: a cantilever from its root to its tip, longer as it extends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, BoomEffect, Floats, boom_row


@dataclass(frozen=True)
class BoomDroop(BoomEffect):
    """Euler-Bernoulli cantilever under tip load F, tip moment M and its own weight W spread over length L.

    deflection = (F L^3 / 3 + M L^2 / 2 + W L^3 / 8) / EI,  slope = (F L^2 / 2 + M L + W L^2 / 6) / EI,
    F and M across the boom's axis, in the bent posture.

    Attributes:
        flexibility_per_Nm2: 1 / EI; 4e-9 is about 20 mm at full reach of a 7 m boom with 2.8 t at its tip.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"flexibility_per_Nm2": 300.0}
    bounded_at = "full_reach"
    flexibility_per_Nm2: float = 4e-9  # noqa: N815 - the unit is N m^2

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam = body.beam(row)
        axis, L = beam.axis, beam.length_m[:, None]

        def across(vectors: Floats) -> Floats:
            along: Floats = np.sum(vectors * axis, axis=1)[:, None]
            return vectors - along * axis

        F, M, W = across(beam.force_newton), across(beam.moment_newton_m), across(beam.own_weight_newton)
        shift_m = F * L**3 / 3 + np.cross(M, axis) * L**2 / 2 + W * L**3 / 8
        slope = np.cross(axis, F) * L**2 / 2 + M * L + np.cross(axis, W) * L**2 / 6
        scale = self.flexibility_per_Nm2
        return (Bend(row, beam.tip_mm, scale * slope, 1e3 * scale * shift_m),)
