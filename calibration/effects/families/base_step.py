"""A carrier that shifted at once: a jack slipped, something struck it, it was set down anew."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.base_motion import base_motion_mm
from calibration.effects.step_times import STEP_SETTINGS, StepFamily, check_step, refined_steps, step_grid
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats

_NAMES = ("tilt_x_rad", "tilt_y_rad", "z_mm")


class BaseStep(StepFamily, TrainedFamily):
    """The base stands otherwise, as a rigid body, in all rows after one instant."""

    name: ClassVar[str] = "base_step"
    equation: ClassVar[str] = "tilts about the base's level x and y axes and rise, for t > time_s"
    source: ClassVar[str] = "rigid motion of the set-up at one instant: a jack that slips, a knock"
    confused_with: ClassVar[tuple[str, ...]] = ("base_settlement", "payload_change", "transducer_index_jump")
    revealed_by: ClassVar[str] = "fixed control points, or one pose again and again all through the session"
    place: ClassVar[str] = "base"
    moves_machine: ClassVar[bool] = False

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        return self._sized(situation, where, step_grid(situation.extra("time_s")))

    def refined(self, situation: Situation, where: str, settings: Settings) -> tuple[Settings, ...]:
        return self._sized(situation, where, refined_steps(situation.extra("time_s"), settings))

    def names(self, settings: Settings) -> tuple[str, ...]:
        check_settings(settings, STEP_SETTINGS, len(_NAMES))
        check_step(settings)
        return _NAMES

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        tilts = (Coefficient(name, "rad", 1e-3, -5e-3, 5e-3) for name in _NAMES[:2])
        return (*tilts, Coefficient(_NAMES[2], "mm", 3.0, -20.0, 20.0))

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        # A comparison with NaN is false: rows without a time stand as before.
        return base_motion_mm(situation, (situation.extra("time_s") > settings["time_s"]).astype(np.float64))

    def _sized(self, situation: Situation, where: str, steps: tuple[Settings, ...]) -> tuple[Settings, ...]:
        if not steps:
            return ()
        known = self.known(situation, where)
        squares = base_motion_mm(situation, np.ones(len(situation)))[known] ** 2
        time_s = situation.extra("time_s")[known]
        return tuple({**s, **sizes(np.sqrt(squares) * (time_s > s["time_s"])[:, None, None])} for s in steps)


FAMILY = BaseStep()
