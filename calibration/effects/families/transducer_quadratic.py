"""A length transducer with a nonlinear characteristic."""

from __future__ import annotations

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class TransducerQuadratic(JointFamily):
    """True length minus reading is a parabola about the middle of the stroke, which ends at the joint's limits."""

    name = "transducer_quadratic"
    equation = "d_L = k (L - L_mid)^2, L as read"
    source = "linearity of length transducers (Zhou et al. 2022: 0.1 % of the stroke), second order"
    confused_with = ("transducer_scale", "boom_droop")
    revealed_by = "the joint alone over its whole stroke, including its middle and both ends"
    fixed = (Coefficient("mm_per_m2", "mm/m^2", 5.0, -20.0, 20.0),)
    kind = "prismatic"

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        middle_mm = sum(context.rig.joint(where).limits) / 2.0
        from_middle_m = (context.reading(where) - middle_mm) / 1e3
        return from_middle_m[:, None] ** 2


FAMILY = TransducerQuadratic()
