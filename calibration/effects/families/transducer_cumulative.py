"""A length transducer that slips slightly with every metre of travel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_MEAN = "mean_m"
_MOST_KNOTS = 16


class TransducerCumulative(JointFamily):
    """True length minus reading grows with the path that the transducer has travelled, in the order of the rows' times.

    The settings tabulate the path over time, for other rows of the same days. The path is constant before the first
    instant and after the last. Without times in the rows or in the model, the rows are treated as one run, ordered by
    time or else as given, with the path zero at the first row. The mean path of the training data is absorbed by the
    kinematics.
    """

    name = "transducer_cumulative"
    equation = "d_L = k * (travelled path - its mean in the training data), path in m"
    source = "slip of a draw wire or a measuring wheel"
    confused_with = ("transducer_index_jump", "base_settlement", "base_step")
    revealed_by = "returning to a pose measured before, after moving the joint back and forth many times"
    fixed = (Coefficient("mm_per_m", "mm/m", 0.03, -0.3, 0.3),)
    kind = "prismatic"
    least_known = 1.0  # as the way that was travelled in other rows would be missing
    depends_on_travel = True

    def needs(self, where: str) -> str:
        del where
        return "the column time_s in all rows or in none"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        del where
        timed = np.isfinite(context.extra("time_s"))
        return timed if timed.any() else ~timed

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known, time_s = self.known(context, where), context.extra("time_s")
        order = np.argsort(time_s[known], kind="stable")  # keeps the given order where there are no times
        path_m = _travelled_m(context.reading(where)[known][order])
        if not len(path_m) or path_m[-1] == 0.0:
            return ()
        mean = float(path_m.mean())
        times, last = np.unique(time_s[known][order][::-1], return_index=True)
        if not np.isfinite(times).all():
            return ({_MEAN: mean},)
        at = np.unique(np.rint(np.linspace(0, len(times) - 1, _MOST_KNOTS)).astype(int))
        path_then = path_m[::-1][last][at]
        knots = zip(times[at].tolist(), path_then.tolist(), strict=True)
        table = {name: value for i, knot in enumerate(knots) for name, value in zip(_knot(i), knot, strict=True)}
        return ({_MEAN: mean, **table},)

    def depends_on_order(self, settings: Settings) -> bool:
        return not _table(settings).size

    def check_settings(self, settings: Settings) -> None:
        knots = len(settings) // 2
        expected = {_MEAN, *(name for i in range(knots) for name in _knot(i))}
        if set(settings) != expected or knots > _MOST_KNOTS or not (np.diff(_table(settings)) > [[0.0], [-1e-9]]).all():
            raise ValueError(
                f"the settings are {_MEAN}, and up to {_MOST_KNOTS} pairs time_0_s and path_0_m ... in rising order"
            )

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        time_s, (times, paths) = context.extra("time_s"), _table(settings)
        known, path_m = self.known(context, where), np.zeros(len(context))
        if len(times) and np.isfinite(time_s).any():
            path_m[known] = np.interp(time_s[known], times, paths)
        else:
            run = np.flatnonzero(known)[np.argsort(time_s[known], kind="stable")]
            path_m[run] = _travelled_m(context.reading(where)[run])
        change: Floats = np.where(known, path_m - settings[_MEAN], 0.0)[:, None]
        return change

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for a random path of the training range."""
        del plausible
        paths = _table(settings)[1]
        return (float(values[0]) * float(np.std(paths if len(paths) else [0.0, 2.0 * settings[_MEAN]]))) ** 2


def _travelled_m(reading_mm: Floats) -> Floats:
    """Return the travelled path (n,) since the first row, in the order of the rows."""
    path_m: Floats = np.abs(np.diff(reading_mm, prepend=reading_mm[:1])).cumsum() / 1e3
    return path_m


def _knot(number: int) -> tuple[str, str]:
    return f"time_{number}_s", f"path_{number}_m"


def _table(settings: Settings) -> Floats:
    """Return the times and paths of the knots, (2, knots)."""
    return np.array([[settings[name] for name in names] for names in zip(*_knots(settings), strict=True)]).reshape(
        2, -1
    )


def _knots(settings: Settings) -> list[tuple[str, str]]:
    return [_knot(i) for i in range(len(settings) // 2)]


FAMILY = TransducerCumulative()
