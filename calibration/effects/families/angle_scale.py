"""An angle encoder whose scale is off."""

from __future__ import annotations

from typing import ClassVar, Literal

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation, refuse_settings
from calibration.observations import Floats


class AngleScale(JointFamily):
    """True angle minus reading grows with the angle as read."""

    name: ClassVar[str] = "angle_scale"
    equation: ClassVar[str] = "d_theta = scale * theta, theta as read"
    source: ClassVar[str] = "gear or scaling error of an encoder, first order of its calibration curve"
    confused_with: ClassVar[tuple[str, ...]] = ("encoder_harmonic", "joint_error_map", "joint_compliance")
    revealed_by: ClassVar[str] = "the joint alone over its whole range, from stop to stop"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("scale",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("scale", "1", 1e-3, -5e-3, 5e-3),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        return situation.reading(where)[:, None]


FAMILY = AngleScale()
