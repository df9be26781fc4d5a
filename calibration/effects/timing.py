"""Settings of effects in time: drifts since the first training row, and steps at one instant.

The instants of steps lie between rows. A coarse grid is searched first, then a fine grid around one of its instants.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibration.effects.base import (
    Family,
    FittedCoefficient,
    JointFamily,
    Settings,
    SizedFamily,
    check_sizes,
    sizes,
)
from calibration.effects.context import EffectContext
from calibration.observations import Floats

DRIFT_SETTINGS = ("from_s", "span_s")
STEP_SETTINGS = ("time_s", "time_error_s", "span_s")

_GRID = 40
_FINE = 80
_LEAST_SIDE = 0.05  # smallest share of the rows on either side of a step
_LEAST_ROWS = 3


def drift_settings(time_s: Floats) -> Settings | None:
    """Return the settings of a drift for the known times (m,) of the training rows; None if all are equal."""
    if len(time_s) == 0 or np.ptp(time_s) == 0.0:
        return None
    return {"from_s": float(time_s.min()), "span_s": float(np.ptp(time_s))}


def check_drift(settings: Settings) -> None:
    """Raise ValueError if the duration of the training is not positive; all `DRIFT_SETTINGS` must be present."""
    if settings["span_s"] <= 0.0:
        raise ValueError("the setting span_s is not above 0")


def elapsed_s(context: EffectContext, settings: Settings) -> Floats:
    """Return the time (n,) since the first training row; 0 where it is not known.

    A drift is extrapolated only for the duration of the training data, both before and after it, and is constant
    beyond that, as drifts end and a model is used for months.
    """
    since = context.extra("time_s") - settings["from_s"]
    held: Floats = np.nan_to_num(np.clip(since, -settings["span_s"], 2.0 * settings["span_s"]))
    return held


class StepFamily(Family):
    """An effect that starts at an instant; the variants are the instants of `step_grid` and `refined_steps`."""

    column = "time_s"
    shape_sigma = 0.03  # small, as a moved part stays in its new place

    def odds(self, settings: Settings) -> float:
        """Return the prior odds of an instant relative to others: the length of time that it represents."""
        return settings["time_error_s"]

    def posterior_settings(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        """Return the most probable step, with the posterior standard deviation of its instant."""
        times, errors = (np.array([form[name] for form in forms]) for name in ("time_s", "time_error_s"))
        weight = probability * [self.odds(form) for form in forms]
        weight /= weight.sum()
        best = int(np.argmax(weight))
        variance = weight @ ((times - times[best]) ** 2 + errors**2)
        return {**forms[best], "time_error_s": math.sqrt(float(variance))}

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        plausible = settings["span_s"] / math.sqrt(12.0)  # uniform between the first and the last row
        instant = FittedCoefficient("time_s", "s", settings["time_s"], settings["time_error_s"], plausible)
        return (*coefficients, instant)


class JointStepFamily(StepFamily, JointFamily):
    """A joint whose zero changes at an instant; the only coefficient is the jump, rad or mm."""

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
        return self._in_readings(after.astype(np.float64))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for rows that are equally likely before and after the step."""
        del plausible, settings
        return float(0.5 * self._in_readings(values[:1])[0] ** 2)

    def _in_readings(self, values: Floats) -> Floats:
        """Convert rad or mm to the unit of the joint's readings, deg or mm."""
        return np.degrees(values) if self.kind == "revolute" else values


class SizedStepFamily(StepFamily, SizedFamily):
    """A base or a prism that changes its place at an instant."""

    def time_s(self, context: EffectContext, where: str) -> Floats:
        """Return the times (n,) of the rows that the step may affect, NaN in all others."""
        del where
        return context.extra("time_s")

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        return self.sized(context, where, step_grid(self.time_s(context, where)))

    def refined(self, context: EffectContext, where: str, settings: Settings) -> tuple[Settings, ...]:
        return self.sized(context, where, refined_steps(self.time_s(context, where), settings))

    def check_settings(self, settings: Settings) -> None:
        check_sizes(settings, STEP_SETTINGS, len(self.fixed))
        check_step(settings)

    def after(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        """Return (n,) 1 in the rows after the step and 0 before it; rows without a time count as before."""
        return (self.time_s(context, where) > settings["time_s"]).astype(np.float64)

    def sized(self, context: EffectContext, where: str, steps: Sequence[Settings]) -> tuple[Settings, ...]:
        """Return the settings of steps with the RMS sizes of their columns added."""
        known = self.known(context, where)
        return tuple({**step, **sizes(self.shift_mm(context, where, step)[known])} for step in steps)


class _Instants(NamedTuple):
    """Instants midway between successive times of rows, with enough rows on either side.

    Attributes:
        time_s: (m,) instants, rising.
        error_s: (m,) standard deviation of a uniformly distributed step between the two neighbouring times.
        before: (m,) number of rows before each instant.
        span_s: duration from the first row to the last.
    """

    time_s: Floats
    error_s: Floats
    before: Floats
    span_s: float

    @classmethod
    def between(cls, time_s: Floats) -> _Instants:
        """Return the instants between the known times among `time_s` (n,)."""
        known = np.sort(time_s[np.isfinite(time_s)])
        times, rows = np.unique(known, return_counts=True)
        before = np.cumsum(rows)[:-1].astype(np.float64)
        least = max(_LEAST_ROWS, math.ceil(_LEAST_SIDE * len(known)))
        inside = (before >= least) & (before <= len(known) - least)
        gap = np.diff(times)
        span = float(times[-1] - times[0]) if len(times) else 0.0
        return cls((times[:-1] + gap / 2.0)[inside], (gap / math.sqrt(12.0))[inside], before[inside], span)

    def settings(self, index: int, least_error_s: float = 0.0) -> Settings:
        """Return the settings of a step at one of the instants."""
        error = max(float(self.error_s[index]), least_error_s)
        return {"time_s": float(self.time_s[index]), "time_error_s": error, "span_s": self.span_s}

    def grid(self) -> list[int]:
        """Choose the instants of a coarse search, with about equal numbers of rows between them."""
        if len(self.time_s) <= _GRID:
            return list(range(len(self.time_s)))
        wanted = np.linspace(self.before[0], self.before[-1], _GRID)
        index = np.minimum(np.searchsorted(self.before, wanted), len(self.before) - 1)
        return sorted(set(index.tolist()))


def step_grid(time_s: Floats) -> tuple[Settings, ...]:
    """Return steps at quantiles of the rows' times; empty where too few rows have a time.

    Each step represents the instants around it: its standard deviation includes them.

    Args:
        time_s: (n,) times of the rows, NaN where not known.
    """
    instants = _Instants.between(time_s)
    grid = instants.grid()
    if not grid:
        return ()
    nearest = np.abs(np.arange(len(instants.time_s))[:, None] - grid).argmin(axis=1)
    errors = np.bincount(nearest, instants.error_s)
    return tuple(instants.settings(index, error) for index, error in zip(grid, errors.tolist(), strict=True))


def refined_steps(time_s: Floats, settings: Settings) -> tuple[Settings, ...]:
    """Return the steps between the two neighbours of a grid step; thinned out evenly where there are very many.

    Args:
        time_s: (n,) times of the rows, NaN where not known.
        settings: the step of the grid.

    Returns:
        The steps; empty where the grid already contains all instants.
    """
    instants = _Instants.between(time_s)
    grid = instants.grid()
    if not grid or len(grid) == len(instants.time_s):
        return ()
    own = min(range(len(grid)), key=lambda i: abs(instants.time_s[grid[i]] - settings["time_s"]))
    low = grid[own - 1] + 1 if own > 0 else 0
    high = grid[own + 1] if own + 1 < len(grid) else len(instants.time_s)
    step = math.ceil((high - low) / _FINE)
    chosen = sorted({*range(low, high, step), grid[own]})
    apart_s = float(instants.time_s[high - 1] - instants.time_s[low]) / max(len(chosen) - 1, 1)
    least = apart_s / math.sqrt(12.0) if step > 1 else 0.0
    return tuple(instants.settings(index, least) for index in chosen)


def check_step(settings: Settings) -> None:
    """Raise ValueError for settings that no search returns; all `STEP_SETTINGS` must be present."""
    negative = [name for name in ("time_error_s", "span_s") if settings[name] < 0.0]
    if negative:
        raise ValueError(f"the setting {negative[0]} is negative")
