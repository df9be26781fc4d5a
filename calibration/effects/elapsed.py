"""How long a drift has gone on: time since the first row of the training."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Settings, Situation
from calibration.observations import Floats

ELAPSED_SETTINGS = ("from_s", "span_s")


def elapsed_settings(time_s: Floats) -> Settings | None:
    """Of the training rows' known times; None where they have but one."""
    if len(time_s) == 0 or np.ptp(time_s) == 0.0:
        return None
    return {"from_s": float(time_s.min()), "span_s": float(np.ptp(time_s))}


def check_elapsed(settings: Settings) -> None:
    """ValueError where the training took no time; the settings are there."""
    if settings["span_s"] <= 0.0:
        raise ValueError("the setting span_s is not above 0")


def elapsed_s(situation: Situation, settings: Settings) -> Floats:
    """(n,) time since the first row of the training; 0 where it is not known.

    No drift goes on for ever, and a model serves for months: before and after the training it is taken to go on for as
    long again as that lasted, and to rest there.
    """
    since = situation.extra("time_s") - settings["from_s"]
    held: Floats = np.nan_to_num(np.clip(since, -settings["span_s"], 2.0 * settings["span_s"]))
    return held
