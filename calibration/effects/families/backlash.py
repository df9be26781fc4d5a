"""Play between encoder and joint."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation, refuse_settings
from calibration.observations import Floats

_HALF_A_RAD_DEG = math.degrees(0.5)


class Backlash(JointFamily):
    """Of encoder and joint one lags behind the other by half the play: the one that is driven through it.

    An encoder on the joint's own side lags behind the joint, which is further along its last motion: the width is
    positive. Behind an encoder at the motor the joint lags, and the width is negative.
    """

    name: ClassVar[str] = "backlash"
    equation: ClassVar[str] = (
        "d_theta = width / 2 * direction of the last motion (column <joint>_dir); width < 0: the joint lags"
    )
    source: ClassVar[str] = "gear play; the approach from the other side shows it"
    confused_with: ClassVar[tuple[str, ...]] = ("load_hysteresis", "gravity_flip_play")
    revealed_by: ClassVar[str] = "coming to the same pose from both sides"
    column: ClassVar[str] = "{where}_dir"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def names(self, settings: Settings) -> tuple[str, ...]:
        refuse_settings(settings)
        return ("width_rad",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("width_rad", "rad", 1e-3, -5e-3, 5e-3),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del settings
        direction = situation.extra(f"{where}_dir")
        change: Floats = _HALF_A_RAD_DEG * np.where(np.isfinite(direction), direction, 0.0)[:, None]
        return change

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible, settings
        return float(_HALF_A_RAD_DEG * values[0]) ** 2


FAMILY = Backlash()
