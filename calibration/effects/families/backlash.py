"""Play between encoder and joint."""

from __future__ import annotations

import math

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_HALF_A_RAD_DEG = math.degrees(0.5)


class Backlash(JointFamily):
    """Play makes the side that is driven through it, encoder or joint, lag by half its width.

    An encoder on the joint's side lags behind the joint, which is further along in the direction of its last motion:
    the width is positive. With an encoder at the motor the joint lags, and the width is negative.
    """

    name = "backlash"
    equation = "d_theta = width / 2 * direction of the last motion (column <joint>_dir); width < 0: the joint lags"
    source = "gear play, visible when a pose is approached from the other side"
    confused_with = ("load_hysteresis", "gravity_flip_play")
    revealed_by = "approaching the same pose from both sides"
    fixed = (Coefficient("width_rad", "rad", 1e-3, -5e-3, 5e-3),)
    column = "{where}_dir"
    kind = "revolute"

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del settings
        direction = context.extra(f"{where}_dir")
        change: Floats = _HALF_A_RAD_DEG * np.where(np.isfinite(direction), direction, 0.0)[:, None]
        return change

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible, settings
        return float(_HALF_A_RAD_DEG * values[0]) ** 2


FAMILY = Backlash()
