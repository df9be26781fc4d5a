"""An angle encoder with a scale error."""

from __future__ import annotations

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class AngleScale(JointFamily):
    """True angle minus reading is proportional to the reading."""

    name = "angle_scale"
    equation = "d_theta = scale * theta, theta as read"
    source = "gear or scaling error of an encoder, first order of its calibration curve"
    confused_with = ("encoder_harmonic", "joint_error_map", "joint_compliance")
    revealed_by = "the joint alone over its whole range, from stop to stop"
    fixed = (Coefficient("scale", "1", 1e-3, -5e-3, 5e-3),)
    kind = "revolute"

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        return context.reading(where)[:, None]


FAMILY = AngleScale()
