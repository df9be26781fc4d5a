"""A carrier that gradually sinks into the ground, or whose jacks creep."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.effects.timing import DRIFT_SETTINGS, check_drift, drift_settings, elapsed_s
from calibration.observations import Floats

_REST_S = "rest_s"
_REST_SHARES = (1.0, 0.5, 0.25)  # candidate values of `rest_s`, as shares of the duration of the training data


class BaseSettlement(SizedFamily):
    """The base drifts as a rigid body from the first training row on, at a constant or a decreasing rate.

    Ground under a load comes to rest: the remaining settlement falls to 1/e within `rest_s`. The rates are then mean
    rates over the duration of the training data.
    """

    name = "base_settlement"
    equation = "tilts about the base's level x and y axes and rise = rates * (t - t_first), or an exponential approach"
    source = "rigid motion of the set-up, settlement under a load, creep of jacks"
    confused_with = ("base_step", "thermal_expansion", "payload_change")
    revealed_by = "the same few poses at the start, in the middle and at the end, or fixed control points"
    fixed = (
        Coefficient("tilt_x_rad_per_h", "rad/h", 0.2e-3, -1e-3, 1e-3),
        Coefficient("tilt_y_rad_per_h", "rad/h", 0.2e-3, -1e-3, 1e-3),
        Coefficient("z_mm_per_h", "mm/h", 1.0, -5.0, 5.0),
    )
    place = "base"
    column = "time_s"
    moves_machine = False

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known = self.known(context, where)
        elapsed = drift_settings(context.extra("time_s")[known])
        if elapsed is None:
            return ()
        slowing = ({**elapsed, _REST_S: share * elapsed["span_s"]} for share in _REST_SHARES)
        return tuple({**form, **sizes(_shift_mm(context, form)[known])} for form in (elapsed, *slowing))

    def odds(self, settings: Settings) -> float:
        return 1.0 / len(_REST_SHARES) if _REST_S in settings else 1.0

    def form(self, settings: Settings) -> str:
        return f"coming to rest within {settings[_REST_S] / 3600.0:.2g} h" if _REST_S in settings else ""

    def check_settings(self, settings: Settings) -> None:
        slowing = (_REST_S,) if _REST_S in settings else ()
        check_sizes(settings, (*DRIFT_SETTINGS, *slowing), len(self.fixed))
        check_drift(settings)
        if slowing and settings[_REST_S] <= 0.0:
            raise ValueError(f"the setting {_REST_S} is not above 0")

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        del where
        return _shift_mm(context, settings)


def _shift_mm(context: EffectContext, settings: Settings) -> Floats:
    amount_s = elapsed_s(context, settings)
    if _REST_S in settings:
        span_s, rest_s = settings["span_s"], settings[_REST_S]
        # Before the first row the drift would have been faster, which is not extrapolated.
        amount_s = span_s * np.expm1(-np.maximum(amount_s, 0.0) / rest_s) / np.expm1(-span_s / rest_s)
    return context.base_motion_mm(amount_s / 3600.0)


FAMILY = BaseSettlement()
