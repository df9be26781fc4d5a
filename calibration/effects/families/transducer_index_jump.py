"""A length transducer that loses its reference."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.effects.timing import STEP_SETTINGS, StepFamily, check_step, refined_steps, step_grid
from calibration.observations import Floats


class TransducerIndexJump(StepFamily, JointFamily):
    """From an instant on, true length minus reading is another one: counts were lost, or a draw wire has slipped."""

    name = "transducer_index_jump"
    equation = "d_L = jump for t > t0, t0 found from the data"
    source = "lost counts or a wrong reference mark of an incremental length transducer"
    confused_with = ("transducer_cumulative", "base_step", "base_settlement")
    revealed_by = "returning to a pose measured before, and driving the transducer over its reference"
    fixed = (Coefficient("jump_mm", "mm", 8.0, -30.0, 30.0),)
    kind = "prismatic"

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
        return np.asarray(context.extra("time_s") > settings["time_s"], dtype=np.float64)[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for rows as likely before the jump as after it."""
        del plausible, settings
        return 0.5 * float(values[0]) ** 2


FAMILY = TransducerIndexJump()
