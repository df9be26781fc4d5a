"""Effects that happen at once, and when: instants between the rows, on a grid and then finely about one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from calibration.effects.base import Family, FittedCoefficient, Settings
from calibration.observations import Floats

STEP_SETTINGS = ("time_s", "time_error_s", "span_s")

_GRID = 40
_FINE = 80
_LEAST_SIDE = 0.05  # share of the rows on either side
_LEAST_ROWS = 3


class StepFamily(Family):
    """An effect from an instant on, its variants those of `step_grid` and `refined_steps`."""

    column: ClassVar[str] = "time_s"

    def odds(self, settings: Settings) -> float:
        return step_odds(settings)

    def settled(self, forms: Sequence[Settings], probability: Floats) -> Settings:
        return settled_step(forms, probability)

    def reported(
        self, settings: Settings, coefficients: tuple[FittedCoefficient, ...]
    ) -> tuple[FittedCoefficient, ...]:
        return (*coefficients, _step_time(settings))


class _Instants(NamedTuple):
    """Instants midway between successive times of rows, with enough rows on either side.

    Attributes:
        time_s: (m,) rising.
        error_s: (m,) standard deviation of a step anywhere between the two rows.
        before: (m,) number of rows before.
        span_s: from the first row to the last.
    """

    time_s: Floats
    error_s: Floats
    before: Floats
    span_s: float

    def settings(self, index: int, least_error_s: float = 0.0) -> Settings:
        """Of one of them."""
        error = max(float(self.error_s[index]), least_error_s)
        return {"time_s": float(self.time_s[index]), "time_error_s": error, "span_s": self.span_s}


def step_grid(time_s: Floats) -> tuple[Settings, ...]:
    """Instants at quantiles of the rows' times (n,), NaN where not known; none where too few rows have a time.

    Each stands for those about it: its error is that of a step anywhere among them.
    """
    instants = _instants(time_s)
    grid = _grid(instants)
    if not grid:
        return ()
    nearest = np.abs(np.arange(len(instants.time_s))[:, None] - grid).argmin(axis=1)
    errors = np.bincount(nearest, instants.error_s)
    return tuple(instants.settings(index, error) for index, error in zip(grid, errors.tolist(), strict=True))


def refined_steps(time_s: Floats, settings: Settings) -> tuple[Settings, ...]:
    """The instants about one of a grid's, between its neighbours; thinned out evenly where there are very many.

    None where the grid has all there are.
    """
    instants = _instants(time_s)
    grid = _grid(instants)
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


def settled_step(forms: Sequence[Settings], probability: Floats) -> Settings:
    """The most probable instant, with the standard deviation that all of them (m,) leave about it.

    Args:
        forms: the instants.
        probability: (m,) what the data give them, if all are as likely beforehand as each other.
    """
    times, errors = (np.array([form[name] for form in forms]) for name in ("time_s", "time_error_s"))
    probability = probability * [step_odds(form) for form in forms]
    probability /= probability.sum()
    best = int(np.argmax(probability))
    variance = probability @ ((times - times[best]) ** 2 + errors**2)
    return {**forms[best], "time_error_s": math.sqrt(float(variance))}


def step_odds(settings: Settings) -> float:
    """How plausible an instant is beside the others: as long as the time is that it stands for."""
    return settings["time_error_s"]


def _step_time(settings: Settings) -> FittedCoefficient:
    """The instant as outputs list it."""
    plausible = settings["span_s"] / math.sqrt(12.0)  # anywhere between the first row and the last
    return FittedCoefficient("time_s", "s", settings["time_s"], settings["time_error_s"], plausible)


def check_step(settings: Settings) -> None:
    """ValueError for an instant that no search finds; the settings are there."""
    negative = [name for name in ("time_error_s", "span_s") if settings[name] < 0.0]
    if negative:
        raise ValueError(f"the setting {negative[0]} is negative")


def _grid(instants: _Instants) -> list[int]:
    """Which of the instants a coarse search looks at: as many rows between any two, as nearly as they come."""
    if len(instants.time_s) <= _GRID:
        return list(range(len(instants.time_s)))
    wanted = np.linspace(instants.before[0], instants.before[-1], _GRID)
    index = np.minimum(np.searchsorted(instants.before, wanted), len(instants.before) - 1)
    return sorted(set(index.tolist()))


def _instants(time_s: Floats) -> _Instants:
    known = np.sort(time_s[np.isfinite(time_s)])
    times, rows = np.unique(known, return_counts=True)
    before = np.cumsum(rows)[:-1].astype(np.float64)
    least = max(_LEAST_ROWS, math.ceil(_LEAST_SIDE * len(known)))
    apart = (before >= least) & (before <= len(known) - least)
    gap = np.diff(times)
    span = float(times[-1] - times[0]) if len(times) else 0.0
    return _Instants((times[:-1] + gap / 2.0)[apart], (gap / math.sqrt(12.0))[apart], before[apart], span)
