"""A length transducer with a scale error."""

from __future__ import annotations

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class TransducerScale(JointFamily):
    """True length minus reading is proportional to the reading."""

    name = "transducer_scale"
    equation = "d_L = scale * L, L as read"
    source = "linearity of length transducers (Zhou et al. 2022: 0.1 % of the stroke), first order"
    confused_with = ("transducer_quadratic", "boom_droop", "thermal_expansion")
    revealed_by = "the joint alone from one end of its stroke to the other"
    fixed = (Coefficient("scale", "1", 2e-3, -1e-2, 1e-2),)
    kind = "prismatic"

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        return context.reading(where)[:, None]


FAMILY = TransducerScale()
