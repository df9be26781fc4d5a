"""Errors of a prism: constant, angle of incidence, seat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import DrawContext, Effect, Floats, Sight, step_time_s


@dataclass(frozen=True)
class PrismConstant(Effect):
    """A prism whose constant is set wrong: every distance to it is wrong by the same length.

    A fix is `mm` farther from the station than the prism, along the line of sight.

    At `station` the effect applies to all prisms, else to the named prism.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"mm": 40.0}
    has_either_sign = True
    acts_at = ("station", "prism")
    where: str = "station"
    mm: float = 3.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where not in ("station", sight.prism):
            return None
        range_mm = np.linalg.norm(sight.place_mm, axis=1)[:, None]
        shift: Floats = self.mm * sight.place_mm / range_mm
        return shift


@dataclass(frozen=True)
class PrismIncidence(Effect):
    """A 360 degree prism whose distances are too long or too short, depending on the side that faces the station.

    Distance error cos1 cos(psi) + sin1 sin(psi), psi the azimuth of the direction to the station.

    psi is measured about the z axis of the frame to which the prism is fixed, from its x axis.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"cos1_mm": 8.0, "sin1_mm": 8.0}
    has_either_sign = True
    acts_at = ("prism",)
    cos1_mm: float = 1.0
    sin1_mm: float = 1.0

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if self.where != sight.prism:
            return None
        line = sight.place_mm / np.linalg.norm(sight.place_mm, axis=1)[:, None]
        back = (-line[:, None, :] @ sight.axes)[:, 0, :]  # towards the station, in the prism's frame
        psi = np.arctan2(back[:, 1], back[:, 0])
        longer = self.cos1_mm * np.cos(psi) + self.sin1_mm * np.sin(psi)
        shift: Floats = longer[:, None] * line
        return shift


@dataclass(frozen=True)
class PrismSeatStep(Effect):
    """A prism whose position in its seat changes at one instant.

    After `time_s` (column `time_s`) the prism is displaced by a vector in the frame to which it is fixed.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_mm": 30.0, "y_mm": 30.0, "z_mm": 30.0}
    has_either_sign = True
    acts_at = ("prism",)
    x_mm: float = 3.0
    y_mm: float = 3.0
    z_mm: float = 3.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def fix_shift_mm(self, sight: Sight) -> Floats | None:
        if sight.prism != self.where:
            return None
        along = np.array([self.x_mm, self.y_mm, self.z_mm])
        after = sight.column("time_s") > self.time_s
        return np.where(after[:, None], sight.axes @ along, 0.0)
