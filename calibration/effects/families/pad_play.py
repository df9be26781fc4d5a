"""Slide pads that leave the inner section of a telescoping boom some play."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, Settings, Situation, refuse_settings
from calibration.effects.boom import BoomFamily, boom_in
from calibration.observations import Floats

_LEAST = 1e-6  # cosine of an elevation
_OVERLAP_LEFT = 0.4  # of the stroke: what the sections overlap when the boom is run out


class PadPlay(BoomFamily):
    """The inner section tilts about the mouth of the outer one until its pads touch.

    The shorter the overlap, the more. To which side says the moment of what it carries about the mouth.
    """

    name: ClassVar[str] = "pad_play"
    equation: ClassVar[str] = "tilt = clearance / overlap * sign(M), overlap = L_max + 0.4 stroke - L"
    source: ClassVar[str] = "geometry of telescopic booms: clearance of the slide pads over their distance"
    confused_with: ClassVar[tuple[str, ...]] = ("boom_droop", "transducer_quadratic", "gravity_flip_play")
    revealed_by: ClassVar[str] = "the same attitude of the boom at many extensions, the last tenth of the stroke too"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        return ({},) if self.shift_mm(situation, where, {}).any() else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("clearance_mm",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("clearance_mm", "mm", 2.0, 0.0, 8.0),)

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where, settings
        boom = boom_in(situation)
        if boom is None or not situation.rig.masses:
            return np.zeros((len(situation), 3, 1))
        low, high = situation.rig.joint(boom.joint).limits
        overlap_mm = np.maximum(high - situation.reading(boom.joint), 0.0) + _OVERLAP_LEFT * (high - low)
        mouth_mm = boom.root_mm + boom.axis * situation.rig.rows[boom.row - 1].a_mm
        places_mm, newton = boom.weights
        hanging = newton * boom.hanging
        about = (hanging[:, None, :] @ places_mm)[:, 0] - hanging.sum(axis=1)[:, None] * mouth_mm
        rise = (boom.axis * boom.down).sum(axis=1)
        # The moment about the mouth, about the level axis across the boom.
        side = np.sign((about * boom.axis).sum(axis=1) - (about * boom.down).sum(axis=1) * rise)
        level = np.sqrt(np.maximum(1.0 - rise**2, 0.0))  # cosine of the boom's elevation; none if it stands on end
        tilt = np.where(level > _LEAST, side / (overlap_mm * np.maximum(level, _LEAST)), 0.0)
        moved = boom.lowered(situation.located.prism_mm - mouth_mm) * (tilt * boom.carries_prism)[:, None]
        return situation.to_station(moved[:, :, None])


FAMILY = PadPlay()
