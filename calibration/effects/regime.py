"""Regimes: parts of the data in which an effect acts, such as beyond an angle, under load or after an hour."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.effects.context import EffectContext
from calibration.observations import ROW, Floats
from calibration.rig.description import Rig

_TORQUE = "torque({})"
_LEAST_KNOWN = 0.9  # smallest share of rows in which a variable must be known
_LATER = (ROW, "time_s")  # rows without these variables count as later than the training


@dataclass(frozen=True)
class Regime:
    """The rows in which a variable is above a border, or the rows in which it is not.

    Attributes:
        variable: the column of a joint's reading, deg or mm; `torque(JOINT)`, the load of a joint in N m, or in N if
            prismatic; an optional column of the observations; or `row`, from 0, where the data have no time.
        above: True for the rows above the border, False for the rows at or below it.
        border: border in the variable's unit.
    """

    variable: str
    above: bool
    border: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON object `regime` of an effect (docs/reference/formats.md, gap)."""
        return {"variable": self.variable, "above": self.above, "border": self.border}

    @property
    def text(self) -> str:
        """Phrase that names the rows of the regime."""
        if self.variable == ROW:
            return f"only in rows {'after' if self.above else 'up to'} {math.floor(self.border)} (from 0)"
        if self.variable == "time_s":
            return f"only {'after' if self.above else 'until'} time_s = {self.border:.6g}"
        return f"only where {self.variable} is {'above' if self.above else 'at most'} {self.border:.4g}"

    def known(self, context: EffectContext) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows for which membership in the regime is known."""
        return np.isfinite(variable_values(context, self.variable)) | (self.variable in _LATER)

    def holds(self, context: EffectContext) -> NDArray[np.bool_]:
        """Return an (n,) mask of the rows in the regime.

        A row without a time or row number counts as later than the training. A row that lacks a different variable is
        in no regime.
        """
        values = variable_values(context, self.variable)
        if self.variable in _LATER:
            values = np.where(np.isfinite(values), values, math.inf)
        return values > self.border if self.above else values <= self.border

    def is_possible(self, rig: Rig) -> bool:
        """Return False if the regime refers to the load of a joint that a rig lacks."""
        return not self.variable.startswith("torque(") or self.variable in map(_TORQUE.format, rig.joint_names)


def variable_values(context: EffectContext, variable: str) -> Floats:
    """Return the (n,) values of a regime's variable, NaN where not known."""
    by_column = {joint.column: joint.name for joint in context.rig.joints}
    if variable in by_column:
        return context.reading(by_column[variable])
    if variable.startswith("torque("):
        return context.torque(variable.removeprefix("torque(").removesuffix(")"))
    return context.extra(variable)


def variables(context: EffectContext) -> dict[str, Floats]:
    """Return variable -> (n,) values of all variables that may define a regime: those that vary in the observations.

    These are the joint readings, their loads, the temperature and other optional columns, and the time, or the order of
    the rows without it.
    """
    rig, columns = context.rig, context.observations.extra
    loads = [_TORQUE.format(j.name) for j in rig.joints if context.greatest_torque(j.name) > 0.0]
    own = [name for name in sorted(columns) if not name.endswith(("_rate", "_Nm", "_dir"))]
    found = {name: variable_values(context, name) for name in (*(j.column for j in rig.joints), *loads, *own)}
    return {name: v for name, v in found.items() if np.isfinite(v).mean() > _LEAST_KNOWN and np.nanstd(v) > 0.0}
