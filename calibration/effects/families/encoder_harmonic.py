"""An encoder that is eccentric, or whose disc is oval."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_SINGLE: tuple[Settings, ...] = ({"k": 1.0}, {"k": 2.0})
_BOTH: Settings = {"k": 1.0, "doubled": 1.0}
_HALF_A_TURN_DEG = 180.0


class EncoderHarmonic(JointFamily):
    """An error that repeats k times per turn: k = 1 for eccentricity, 2 for an oval or tilted disc; or both at once.

    Over less than half a turn the two together fit almost any curve, even a straight line. That variant is not used
    there.
    """

    name = "encoder_harmonic"
    equation = (
        "d_theta = cosk cos(k theta) + sink sin(k theta), k = 1 or 2; for k = 1 optionally plus the same terms of 2k"
    )
    source = "eccentricity of a rotary encoder's disc: e / r = error in rad, once a turn"
    confused_with = ("angle_scale", "joint_error_map", "joint_compliance")
    revealed_by = "the joint alone over its whole range, in equal steps"
    kind = "revolute"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        reading = context.reading(where)
        covers_both = len(reading) > 0 and np.ptp(reading) >= _HALF_A_TURN_DEG
        return (*_SINGLE, _BOTH) if covers_both else _SINGLE

    def form(self, settings: Settings) -> str:
        return f"k = {settings['k']:g}{' and 2k' if 'doubled' in settings else ''}"

    def names(self, settings: Settings) -> tuple[str, ...]:
        if settings not in (*_SINGLE, _BOTH):
            raise ValueError(
                "the settings are k, 1 or 2, and for k = 1 optionally doubled = 1, if the terms of 2k are included"
            )
        return ("cosk_rad", "sink_rad", *(("cos2k_rad", "sin2k_rad") if "doubled" in settings else ()))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del context, where
        return tuple(Coefficient(name, "rad", 1.5e-3, -6e-3, 6e-3) for name in self.names(settings))

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        once = settings["k"] * np.radians(context.reading(where))
        angles = (once, 2.0 * once) if "doubled" in settings else (once,)
        change: Floats = np.degrees([turn(angle) for angle in angles for turn in (np.cos, np.sin)]).T
        return change


FAMILY = EncoderHarmonic()
