"""A length transducer that loses its reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, FittedCoefficient, JointFamily, Settings, Situation
from calibration.effects.step_times import (
    STEP_SETTINGS,
    check_step,
    refined_steps,
    settled_step,
    step_grid,
    step_odds,
    step_time,
)
from calibration.observations import Floats


class TransducerIndexJump(JointFamily):
    """From an instant on, true length minus reading is another one: counts were lost, or a draw wire has slipped."""

    name: ClassVar[str] = "transducer_index_jump"
    equation: ClassVar[str] = "d_L = jump for t > t0, t0 found from the data"
    source: ClassVar[str] = "lost counts or a wrong reference mark of an incremental length transducer"
    confused_with: ClassVar[tuple[str, ...]] = ("transducer_cumulative", "base_step", "base_settlement")
    revealed_by: ClassVar[str] = "returning to a pose measured before, and driving the transducer over its reference"
    column: ClassVar[str] = "time_s"
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

    def odds(self, settings: Settings) -> float:
        return step_odds(settings)

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        return settled_step(forms, probability)

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        return (*coefficients, step_time(settings))

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Before and after the jump are equally likely."""
        del plausible, settings
        return 0.5 * float(values[0]) ** 2


FAMILY = TransducerIndexJump()
