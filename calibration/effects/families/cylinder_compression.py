"""A cylinder whose oil gives way to pressure."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.observations import Floats


class CylinderCompression(JointFamily):
    """True length minus reading goes with the pressure in the joint's own cylinder, column `<joint>_bar`."""

    name: ClassVar[str] = "cylinder_compression"
    equation: ClassVar[str] = "d_s = k * pressure (column <joint>_bar)"
    source: ClassVar[str] = "bulk modulus of hydraulic oil, about 14 000 bar, and the stretch of barrel and rod"
    confused_with: ClassVar[tuple[str, ...]] = ("joint_compliance", "boom_droop", "transducer_scale")
    revealed_by: ClassVar[str] = "the same length under another pressure: against a stop, or with a payload and without"
    column: ClassVar[str] = "{where}_bar"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "prismatic"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        pressure_bar = situation.extra(f"{where}_bar")[self.known(situation, where)]
        usual = float(np.sqrt(np.mean(pressure_bar**2))) if len(pressure_bar) else 0.0
        return ({"pressure_bar": usual},) if usual > 0.0 else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        if set(settings) != {"pressure_bar"} or settings["pressure_bar"] <= 0.0:
            raise ValueError("the only setting is pressure_bar, the usual pressure of the training rows")
        return ("mm_per_bar",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("mm_per_bar", "mm/bar", 0.01, -0.1, 0.1),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        return np.nan_to_num(situation.extra(f"{where}_bar"))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return (float(values[0]) * settings["pressure_bar"]) ** 2


FAMILY = CylinderCompression()
