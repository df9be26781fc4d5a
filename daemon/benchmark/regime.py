"""The regime, the part of the data in which a hidden effect acts, and its comparison with an answer.

An effect of an answer has `regime`: null for all rows, or `{"variable": text, "above": bool, "border": number}`. The
variable is a joint (its reading, deg or mm), `torque(JOINT)` (N m or N), an observation column, or, in data without
time, `row` (the row number, from 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_UNITS = ("_deg", "_mm")  # of a joint's column


@dataclass(frozen=True)
class TrueRegime:
    """The part of the data in which a hidden effect acts.

    Attributes:
        variable: as in the module's docstring.
        above: True if the effect acts in the rows above the border, False if in the other rows.
        border: in the variable's unit.
        low, high: bounds within which a reported border is right.
    """

    variable: str
    above: bool
    border: float
    low: float
    high: float

    def is_part(self, told: Mapping[str, Any] | None) -> bool:
        """Return True if a reported regime has this variable and this side of the border."""
        if told is None:
            return False
        variable = str(told["variable"])
        for unit in _UNITS:
            variable = variable.removesuffix(unit)
        return variable == self.variable and bool(told["above"]) == self.above

    def is_border(self, told: Mapping[str, Any] | None) -> bool:
        """Return True if a reported regime is this part of the data with a right border."""
        return told is not None and self.is_part(told) and self.low <= float(told["border"]) <= self.high


def regime_of(effect: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the regime of an effect of an answer; None for all rows."""
    regime: Mapping[str, Any] | None = effect.get("regime")
    return regime
