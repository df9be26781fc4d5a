"""A carrier that sinks into the ground, or whose jacks give way, little by little."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from calibration.effects.base import Coefficient, Settings, Situation
from calibration.effects.base_motion import base_motion_mm
from calibration.effects.elapsed import ELAPSED_SETTINGS, check_elapsed, elapsed_s, elapsed_settings
from calibration.effects.trained import TrainedFamily, check_settings, sizes
from calibration.observations import Floats

_REST_S = "rest_s"
_REST_SHARES = (1.0, 0.5, 0.25)  # of the time of the training
_NAMES = ("tilt_x_rad_per_h", "tilt_y_rad_per_h", "z_mm_per_h")


class BaseSettlement(TrainedFamily):
    """The base drifts as a rigid body from the first row of the training on, at a steady rate or ever slower.

    Ground that gives way under a load comes to rest: what is still to come falls to 1/e within `rest_s`. The rates are
    then the mean ones over the time of the training.
    """

    name: ClassVar[str] = "base_settlement"
    equation: ClassVar[str] = (
        "tilts about the base's level x and y axes and rise = rates * (t - t_first), or as much, coming to rest"
    )
    source: ClassVar[str] = "rigid motion of the set-up, settlement under a load, creep of jacks"
    confused_with: ClassVar[tuple[str, ...]] = ("base_step", "thermal_expansion", "payload_change")
    revealed_by: ClassVar[str] = (
        "the same few poses at the start, in the middle and at the end, or fixed control points"
    )
    place: ClassVar[str] = "base"
    column: ClassVar[str] = "time_s"
    moves_machine: ClassVar[bool] = False

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        known = self.known(situation, where)
        elapsed = elapsed_settings(situation.extra("time_s")[known])
        if elapsed is None:
            return ()
        slowing = ({**elapsed, _REST_S: share * elapsed["span_s"]} for share in _REST_SHARES)
        return tuple({**form, **sizes(_shift_mm(situation, form)[known])} for form in (elapsed, *slowing))

    def odds(self, settings: Settings) -> float:
        return 1.0 / len(_REST_SHARES) if _REST_S in settings else 1.0

    def form(self, settings: Settings) -> str:
        return f"coming to rest within {settings[_REST_S] / 3600.0:.2g} h" if _REST_S in settings else ""

    def names(self, settings: Settings) -> tuple[str, ...]:
        slowing = (_REST_S,) if _REST_S in settings else ()
        check_settings(settings, (*ELAPSED_SETTINGS, *slowing), len(_NAMES))
        check_elapsed(settings)
        if slowing and settings[_REST_S] <= 0.0:
            raise ValueError(f"the setting {_REST_S} is not above 0")
        return _NAMES

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        tilts = (Coefficient(name, "rad/h", 0.2e-3, -1e-3, 1e-3) for name in _NAMES[:2])
        return (*tilts, Coefficient(_NAMES[2], "mm/h", 1.0, -5.0, 5.0))

    def shift_mm(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(situation, settings)


def _shift_mm(situation: Situation, settings: Settings) -> Floats:
    amount_s = elapsed_s(situation, settings)
    if _REST_S in settings:
        span_s, rest_s = settings["span_s"], settings[_REST_S]
        # Before the first row nothing is known of a drift that was faster then.
        amount_s = span_s * np.expm1(-np.maximum(amount_s, 0.0) / rest_s) / np.expm1(-span_s / rest_s)
    return base_motion_mm(situation, amount_s / 3600.0)


FAMILY = BaseSettlement()
