"""An encoder that slips on its shaft."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.effects.timing import STEP_SETTINGS, StepFamily, check_step, refined_steps, step_grid
from calibration.observations import Floats


class ZeroStep(StepFamily, JointFamily):
    """From an instant on a revolute joint has another zero; that of a prismatic one is `transducer_index_jump`."""

    name = "zero_step"
    equation = "d_theta = jump for t > time_s, time_s found from the data"
    source = "a coupling that slips, an encoder that was mounted anew or lost its reference"
    confused_with = ("base_shift", "base_step", "prism_seat_step", "backlash")
    revealed_by = "returning to poses measured before, with a prism before the joint and one behind it"
    fixed = (Coefficient("jump_rad", "rad", 2e-3, -35e-3, 35e-3),)
    kind = "revolute"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        del where
        return step_grid(context.extra("time_s"))

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        del where
        return refined_steps(context.extra("time_s"), settings)

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != set(STEP_SETTINGS):
            raise ValueError(f"the settings are {', '.join(STEP_SETTINGS)}")
        check_step(settings)

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        after = context.extra("time_s") > settings["time_s"]
        return np.degrees(after.astype(np.float64))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for rows as likely before the step as after it."""
        del plausible, settings
        return 0.5 * float(np.degrees(values[0])) ** 2


FAMILY = ZeroStep()
