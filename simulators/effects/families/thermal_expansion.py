"""Steel that grows with its temperature: every length of the machine by the same share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.base import Body, Effect, Floats, warming


@dataclass(frozen=True)
class ThermalExpansion(Effect):
    """All lengths x (1 + alpha (T - T0)), T of the column `temperature_degC`; the base's origin stays.

    Attributes:
        per_K: alpha; 12e-6 for steel.
        at_degC: T0; None: the mean of the rows given.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"per_K": 2.5e-5}
    acts_at = ("boom",)
    where: str = "boom"
    per_K: float = 12.0e-6  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def growth(self, body: Body) -> Floats:
        return self.per_K * warming(body, self.at_degC)
