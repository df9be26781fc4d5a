"""A cylinder whose oil is compressed by the pressure."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats


class CylinderCompression(JointFamily):
    """True length minus reading is proportional to the pressure in the joint's own cylinder, column `<joint>_bar`."""

    name = "cylinder_compression"
    equation = "d_s = k * pressure (column <joint>_bar)"
    source = "bulk modulus of hydraulic oil, about 14 000 bar, and the stretch of barrel and rod"
    confused_with = ("joint_compliance", "boom_droop", "transducer_scale")
    revealed_by = "the same length at different pressures: against a stop, or with a payload and without"
    fixed = (Coefficient("mm_per_bar", "mm/bar", 0.01, -0.1, 0.1),)
    column = "{where}_bar"
    kind = "prismatic"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        pressure_bar = context.extra(f"{where}_bar")[self.known(context, where)]
        usual = float(np.sqrt(np.mean(pressure_bar**2))) if len(pressure_bar) else 0.0
        return ({"pressure_bar": usual},) if usual > 0.0 else ()

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != {"pressure_bar"} or settings["pressure_bar"] <= 0.0:
            raise ValueError("the only setting is pressure_bar, the usual pressure of the training rows")

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        return np.nan_to_num(context.extra(f"{where}_bar"))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return (float(values[0]) * settings["pressure_bar"]) ** 2


FAMILY = CylinderCompression()
