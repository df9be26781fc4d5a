"""Worn slide pads: the inner section of the boom tilts in the outer one to the side that its load asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, BoomEffect, boom_row


@dataclass(frozen=True)
class PadPlay(BoomEffect):
    """Tilt clearance / overlap about the level axis across the boom, at the mouth of the outer section.

    The overlap is the stroke's upper limit + 0.4 strokes - the extension; the side is that of the moment at the mouth.
    Everything from the boom's tip on moves.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"clearance_mm": 8.0}
    clearance_mm: float = 2.0

    def bends(self, body: Body) -> Sequence[Bend]:
        row = boom_row(body.rig)
        beam, outer_mm = body.beam(row), body.rig.rows[row - 1].a_mm
        transducer = next(joint for n, what, joint, _ in body.rig.couplings() if n == row and what == "a")
        low, high = body.rig.joint(transducer).limits
        overlap_mm = high + 0.4 * (high - low) - body.true[transducer]
        mouth = beam.tip_mm - (1e3 * beam.length_m - outer_mm)[:, None] * beam.axis
        moment = beam.moment_newton_m + np.cross((beam.tip_mm - mouth) / 1e3, beam.force_newton)
        level = np.cross(beam.axis, body.gravity)
        level = level / np.maximum(np.linalg.norm(level, axis=1), 1e-12)[:, None]  # a boom on end has none
        side = np.sign(np.sum(moment * level, axis=1))
        tilt = (side * self.clearance_mm / overlap_mm)[:, None] * level
        return (Bend(row, mouth, tilt, np.zeros_like(tilt)),)
