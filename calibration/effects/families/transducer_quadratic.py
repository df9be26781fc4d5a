"""A length transducer whose characteristic is bent."""

from __future__ import annotations

from typing import ClassVar, Literal

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation, joint_of, refuse_settings
from calibration.observations import Floats


class TransducerQuadratic(JointFamily):
    """True length minus reading is a parabola about the middle of the stroke, the joint's limits being its ends."""

    name: ClassVar[str] = "transducer_quadratic"
    equation: ClassVar[str] = "d_L = k (L - L_mid)^2, L as read"
    source: ClassVar[str] = "linearity of length transducers (Zhou et al. 2022: 0.1 % of the stroke), second order"
    confused_with: ClassVar[tuple[str, ...]] = ("transducer_scale", "boom_droop")
    revealed_by: ClassVar[str] = "the joint alone over its whole stroke, with its middle and both ends"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "prismatic"

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("mm_per_m2",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("mm_per_m2", "mm/m^2", 5.0, -20.0, 20.0),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        middle_mm = sum(joint_of(situation, where).limits) / 2.0
        from_middle_m = (situation.reading(where) - middle_mm) / 1e3
        return from_middle_m[:, None] ** 2


FAMILY = TransducerQuadratic()
