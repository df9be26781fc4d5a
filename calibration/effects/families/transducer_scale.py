"""A length transducer whose scale is off."""

from __future__ import annotations

from typing import ClassVar, Literal

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation, refuse_settings
from calibration.observations import Floats


class TransducerScale(JointFamily):
    """True length minus reading grows with the length as read."""

    name: ClassVar[str] = "transducer_scale"
    equation: ClassVar[str] = "d_L = scale * L, L as read"
    source: ClassVar[str] = "linearity of length transducers (Zhou et al. 2022: 0.1 % of the stroke), first order"
    confused_with: ClassVar[tuple[str, ...]] = ("transducer_quadratic", "boom_droop", "thermal_expansion")
    revealed_by: ClassVar[str] = "the joint alone from one end of its stroke to the other"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "prismatic"

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("scale",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("scale", "1", 2e-3, -1e-2, 1e-2),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        return situation.reading(where)[:, None]


FAMILY = TransducerScale()
