"""A length transducer that loses its reference."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.effects.step_times import STEP_SETTINGS, StepFamily, check_step, refined_steps, step_grid
from calibration.observations import Floats


class TransducerIndexJump(StepFamily, JointFamily):
    """From an instant on, true length minus reading is another one: counts were lost, or a draw wire has slipped."""

    name: ClassVar[str] = "transducer_index_jump"
    equation: ClassVar[str] = "d_L = jump for t > t0, t0 found from the data"
    source: ClassVar[str] = "lost counts or a wrong reference mark of an incremental length transducer"
    confused_with: ClassVar[tuple[str, ...]] = ("transducer_cumulative", "base_step", "base_settlement")
    revealed_by: ClassVar[str] = "returning to a pose measured before, and driving the transducer over its reference"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "prismatic"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        del where
        return step_grid(situation.extra("time_s"))

    def refined(self, situation: Situation, where: str, settings: Settings) -> tuple[Settings, ...]:
        del where
        return refined_steps(situation.extra("time_s"), settings)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if set(settings) != set(STEP_SETTINGS):
            raise ValueError(f"the settings are {', '.join(STEP_SETTINGS)}")
        check_step(settings)
        return ("jump_mm",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("jump_mm", "mm", 8.0, -30.0, 30.0),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return np.asarray(situation.extra("time_s") > settings["time_s"], dtype=np.float64)[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Before and after the jump are equally likely."""
        del plausible, settings
        return 0.5 * float(values[0]) ** 2


FAMILY = TransducerIndexJump()
