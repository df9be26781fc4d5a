"""The part of the data in which a hidden effect acts, and how an answer tells it.

An effect of an answer has `regime`: null for all rows, or `{"variable": text, "above": bool, "border": number}`. The
variable is a joint (its reading, deg or mm), `torque(JOINT)` (N m, or N), an observation column, or `row` (the row's
number, from 0) where the data have no time.
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
        variable: see the module.
        above: in the rows above the border; else in all others.
        border: in the variable's unit.
        low, high: a border between these is right.
    """

    variable: str
    above: bool
    border: float
    low: float
    high: float

    def is_part(self, told: Mapping[str, Any] | None) -> bool:
        """Return whether an answer names this variable and this side of it."""
        if told is None:
            return False
        variable = str(told["variable"])
        for unit in _UNITS:
            variable = variable.removesuffix(unit)
        return variable == self.variable and bool(told["above"]) == self.above

    def is_border(self, told: Mapping[str, Any] | None) -> bool:
        """Return whether an answer names this part, with a border that is right."""
        return told is not None and self.is_part(told) and self.low <= float(told["border"]) <= self.high


def regime_of(effect: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the part of the data in which an effect of an answer acts; None for all rows."""
    regime: Mapping[str, Any] | None = effect.get("regime")
    return regime
