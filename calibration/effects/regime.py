"""Regimes: the part of the data in which an effect acts, such as beyond an angle, under load or after an hour."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.effects.context import EffectContext
from calibration.observations import ROW, Floats
from calibration.rig.description import Rig

_TORQUE = "torque({})"
_LEAST_KNOWN = 0.9  # share of the rows
_LATER = (ROW, "time_s")  # what is not told apart by these comes after the training


@dataclass(frozen=True)
class Regime:
    """The rows in which a variable is above a border, or all others.

    Attributes:
        variable: the column of a joint's reading, deg or mm; `torque(JOINT)`, its load in N m, or N where it is
            prismatic; an optional column of the observations; or `row`, from 0, where the data have no time.
        above: in the rows above the border; else in those at or below it.
        border: in the variable's unit.
    """

    variable: str
    above: bool
    border: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object `regime` of an effect (docs/reference/formats.md, gap)."""
        return {"variable": self.variable, "above": self.above, "border": self.border}

    @property
    def text(self) -> str:
        """A phrase: in which rows."""
        if self.variable == ROW:
            return f"only in rows {'after' if self.above else 'up to'} {math.floor(self.border)} (from 0)"
        if self.variable == "time_s":
            return f"only {'after' if self.above else 'until'} time_s = {self.border:.6g}"
        return f"only where {self.variable} is {'above' if self.above else 'at most'} {self.border:.4g}"

    def known(self, context: EffectContext) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows of which it is known whether they are in the part."""
        return np.isfinite(variable_values(context, self.variable)) | (self.variable in _LATER)

    def holds(self, context: EffectContext) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows in the part.

        A row without a time, or without the number of a row, comes after the training; one that lacks another variable
        is in no part.
        """
        values = variable_values(context, self.variable)
        if self.variable in _LATER:
            values = np.where(np.isfinite(values), values, math.inf)
        return values > self.border if self.above else values <= self.border

    def is_possible(self, rig: Rig) -> bool:
        """True unless it names the load of a joint that a rig lacks."""
        return not self.variable.startswith("torque(") or self.variable in map(_TORQUE.format, rig.joint_names)


def variable_values(context: EffectContext, variable: str) -> Floats:
    """Return the (n,) values of a part's variable, NaN where they are not known."""
    by_column = {joint.column: joint.name for joint in context.rig.joints}
    if variable in by_column:
        return context.reading(by_column[variable])
    if variable.startswith("torque("):
        return context.torque(variable.removeprefix("torque(").removesuffix(")"))
    return context.extra(variable)


def variables(context: EffectContext) -> dict[str, Floats]:
    """Return variable -> (n,) values of all that a part of these observations may be told by: those that vary.

    Readings of joints, their loads, the temperature and other optional columns, and the time, or the order of the rows
    where that is not known.
    """
    rig, columns = context.rig, context.observations.extra
    loads = [_TORQUE.format(j.name) for j in rig.joints if context.greatest_torque(j.name) > 0.0]
    own = [name for name in sorted(columns) if not name.endswith(("_rate", "_Nm", "_dir"))]
    found = {name: variable_values(context, name) for name in (*(j.column for j in rig.joints), *loads, *own)}
    return {name: v for name, v in found.items() if np.isfinite(v).mean() > _LEAST_KNOWN and np.nanstd(v) > 0.0}
