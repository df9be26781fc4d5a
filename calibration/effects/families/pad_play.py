"""Slide pads that leave the inner section of a telescoping boom some play."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.base import Coefficient, FittedCoefficient, Settings
from calibration.effects.boom import BoomFamily, boom_in
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_LEAST = 1e-6  # cosine of an elevation
_LEFT, _SPREAD = "left", "left_spread"
# Of the stroke: what the sections may overlap when the boom is run out, half an octave apart, the usual one first.
_OVERLAPS = tuple((0.4 * 2.0 ** (np.array([0, -1, 1, -2, 2, -3, -4]) / 2.0)).tolist())
_STEP = 0.5 * math.log(2.0)


class PadPlay(BoomFamily):
    """The inner section tilts about the mouth of the outer one until its pads touch.

    The shorter the overlap, the more. To which side says the moment of what it carries about the mouth. How much
    overlap is left when the boom is run out no rig file says; the data choose, and leave it open by a standard
    deviation of its logarithm.
    """

    name = "pad_play"
    equation = "tilt = clearance / overlap * sign(M), overlap = L_max + left stroke - L"
    source = "geometry of telescopic booms: clearance of the slide pads over their distance"
    confused_with = ("boom_droop", "transducer_quadratic", "gravity_flip_play")
    revealed_by = "the same attitude of the boom at many extensions, the last tenth of the stroke too"
    fixed = (Coefficient("clearance_mm", "mm", 2.0, 0.0, 8.0),)

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        forms = tuple({_LEFT: share, _SPREAD: _STEP / math.sqrt(12.0)} for share in _OVERLAPS)
        return forms if self.shift_mm(context, where, forms[0]).any() else ()

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Return all variants: the settled form lies between them."""
        del settings
        return self.variants(context, where)

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the mean of the logarithm, and the standard deviation that all of the forms leave about it."""
        left = np.log([form[_LEFT] for form in forms])
        own = np.array([form[_SPREAD] for form in forms])
        mean = float(probability @ left)
        return {_LEFT: math.exp(mean), _SPREAD: math.sqrt(float(probability @ ((left - mean) ** 2 + own**2)))}

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the clearance; data only fix clearance / (left (1 + left)), the tilt run out less that drawn in."""
        clearance = coefficients[0]
        share = settings[_SPREAD] * (1.0 + settings[_LEFT] / (1.0 + settings[_LEFT]))
        return (replace(clearance, standard_error=math.hypot(clearance.standard_error, share * clearance.value)),)

    def form(self, settings: Settings) -> str:
        return f"{settings[_LEFT]:.2g} of the stroke overlap when run out"

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != {_LEFT, _SPREAD} or not settings[_LEFT] > 0.0 or settings[_SPREAD] < 0.0:
            raise ValueError(
                f"the settings are {_LEFT}, the overlap of the boom run out as a share of the stroke, and {_SPREAD}, "
                "the standard deviation of its logarithm"
            )

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        boom = boom_in(context)
        if boom is None or not context.rig.masses:
            return np.zeros((len(context), 3, 1))
        low, high = context.rig.joint(boom.joint).limits
        overlap_mm = np.maximum(high - context.reading(boom.joint), 0.0) + settings[_LEFT] * (high - low)
        mouth_mm = boom.root_mm + boom.axis * boom.outer_mm
        places_mm, newton = boom.weights
        hanging = newton * boom.hanging
        about = (hanging[:, None, :] @ places_mm)[:, 0] - hanging.sum(axis=1)[:, None] * mouth_mm
        rise = (boom.axis * boom.down).sum(axis=1)
        # The moment about the mouth, about the level axis across the boom.
        side = np.sign((about * boom.axis).sum(axis=1) - (about * boom.down).sum(axis=1) * rise)
        level = np.sqrt(np.maximum(1.0 - rise**2, 0.0))  # cosine of the boom's elevation; none if it stands on end
        tilt = np.where(level > _LEAST, side / (overlap_mm * np.maximum(level, _LEAST)), 0.0)
        moved = boom.lowered(context.located.prism_mm - mouth_mm) * (tilt * boom.carries_prism)[:, None]
        return context.to_station(moved[:, :, None])


FAMILY = PadPlay()
