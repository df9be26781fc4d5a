"""Play of the inner section of a telescoping boom in its slide pads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.base import Coefficient, FittedCoefficient, Settings
from calibration.effects.boom import BoomFamily, boom_in
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_LEAST = 1e-6  # smallest cosine of the elevation
_LEFT, _SPREAD = "left", "left_spread"
# Possible overlaps of the sections at full extension, as shares of the stroke: half an octave apart, most usual first.
_OVERLAPS = tuple((0.4 * 2.0 ** (np.array([0, -1, 1, -2, 2, -3, -4]) / 2.0)).tolist())
_STEP = 0.5 * math.log(2.0)


class PadPlay(BoomFamily):
    """The inner section tilts about the mouth of the outer one until its pads touch.

    The tilt is larger the shorter the overlap, and its sign is that of the moment about the mouth of all carried
    weights. The overlap at full extension is not in the rig file. It is estimated from the data, with a standard
    deviation of its logarithm.
    """

    name = "pad_play"
    equation = "tilt = clearance / overlap * sign(M), overlap = L_max + left stroke - L"
    source = "geometry of telescopic booms: clearance of the slide pads over their distance"
    confused_with = ("boom_droop", "transducer_quadratic", "gravity_flip_play")
    revealed_by = "the same attitude of the boom at many extensions, including the last tenth of the stroke"
    fixed = (Coefficient("clearance_mm", "mm", 2.0, 0.0, 8.0),)

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        forms = tuple({_LEFT: share, _SPREAD: _STEP / math.sqrt(12.0)} for share in _OVERLAPS)
        return forms if self.shift_mm(context, where, forms[0]).any() else ()

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        """Return all variants, as the final settings are interpolated between them."""
        del settings
        return self.variants(context, where)

    def posterior_settings(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the posterior mean and standard deviation of the logarithm of the overlap."""
        left = np.log([form[_LEFT] for form in forms])
        own = np.array([form[_SPREAD] for form in forms])
        mean = float(probability @ left)
        return {_LEFT: math.exp(mean), _SPREAD: math.sqrt(float(probability @ ((left - mean) ** 2 + own**2)))}

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        """Return the clearance with the overlap's uncertainty added to its standard error.

        The data determine only clearance / (left (1 + left)), the difference of the tilts at full and no extension.
        """
        clearance = coefficients[0]
        share = settings[_SPREAD] * (1.0 + settings[_LEFT] / (1.0 + settings[_LEFT]))
        return (replace(clearance, standard_error=math.hypot(clearance.standard_error, share * clearance.value)),)

    def form(self, settings: Settings) -> str:
        return f"{settings[_LEFT]:.2g} of the stroke overlap at full extension"

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != {_LEFT, _SPREAD} or not settings[_LEFT] > 0.0 or settings[_SPREAD] < 0.0:
            raise ValueError(
                f"the settings are {_LEFT}, the overlap at full extension as a share of the stroke, and {_SPREAD}, "
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
        # Sign of the moment at the mouth about the level axis across the boom.
        side = np.sign((about * boom.axis).sum(axis=1) - (about * boom.down).sum(axis=1) * rise)
        level = np.sqrt(np.maximum(1.0 - rise**2, 0.0))  # cosine of the elevation; zero for a vertical boom
        tilt = np.where(level > _LEAST, side / (overlap_mm * np.maximum(level, _LEAST)), 0.0)
        moved = boom.lowered(context.located.prism_mm - mouth_mm) * (tilt * boom.carries_prism)[:, None]
        return context.to_station(moved[:, :, None])


FAMILY = PadPlay()
