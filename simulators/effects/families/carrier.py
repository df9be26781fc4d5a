"""Effects at the base: a carrier that leans, sinks, slips or is pushed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from simulators.effects.base import Bend, Body, DrawContext, Effect, hours_since, step_time_s


@dataclass(frozen=True)
class BaseCompliance(Effect):
    """A carrier on springs: it leans to the side that its boom loads.

    Tilt about the x and y axes through the base's origin, proportional to the moment of all weights about each axis.

    Attributes:
        x_rad_per_Nm, y_rad_per_Nm: compliance of the springs about each axis.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_rad_per_Nm": 15e-3, "y_rad_per_Nm": 15e-3}
    bounded_at = "largest_load"
    acts_at = ("base",)
    where: str = "base"
    x_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m
    y_rad_per_Nm: float = 5e-9  # noqa: N815 - the unit is N m

    def bends(self, body: Body) -> Sequence[Bend]:
        moment = body.overturning_newton_m()
        tilt = np.array([self.x_rad_per_Nm, self.y_rad_per_Nm, 0.0]) * moment
        return (Bend(0, np.zeros_like(tilt), tilt, np.zeros_like(tilt)),)


@dataclass(frozen=True)
class BaseSettlement(Effect):
    """Ground that gives way: the carrier sinks and tilts steadily.

    Tilts about the x and y axes of the base's frame through its origin, and a shift along z, proportional to time.

    Time is the column `time_s`.

    Attributes:
        tilt_x_rad_per_h, tilt_y_rad_per_h, z_mm_per_h: the rates.
        first_s: time at which the effect is zero; None for the earliest time of the given rows.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"tilt_x_rad_per_h": 1e-3, "tilt_y_rad_per_h": 1e-3, "z_mm_per_h": 5.0}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    tilt_x_rad_per_h: float = 0.2e-3
    tilt_y_rad_per_h: float = 0.2e-3
    z_mm_per_h: float = 1.0
    first_s: float | None = None

    def bends(self, body: Body) -> Sequence[Bend]:
        hours = hours_since(body, self.first_s)[:, None]
        tilt = hours * np.array([self.tilt_x_rad_per_h, self.tilt_y_rad_per_h, 0.0])
        return (Bend(0, np.zeros_like(tilt), tilt, hours * np.array([0.0, 0.0, self.z_mm_per_h])),)


@dataclass(frozen=True)
class BaseShift(Effect):
    """A carrier that is pushed: from one instant on it has a different position and heading on the ground.

    After `time_s` (column `time_s`) a rotation about the z axis of the base's frame, and shifts along its x and y.

    The rotation is about the base's origin.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"x_mm": 50.0, "y_mm": 50.0, "heading_rad": 10e-3}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    x_mm: float = 5.0
    y_mm: float = 5.0
    heading_rad: float = 1e-3
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def bends(self, body: Body) -> Sequence[Bend]:
        after = np.where(body.column("time_s") > self.time_s, 1.0, 0.0)
        none = np.zeros_like(after)
        heading = np.column_stack([none, none, self.heading_rad * after])
        shift_mm = np.column_stack([self.x_mm * after, self.y_mm * after, none])
        return (Bend(0, np.zeros_like(heading), heading, shift_mm),)


@dataclass(frozen=True)
class BaseStep(Effect):
    """A jack that slips: from one instant on the carrier has a different height and tilt.

    After `time_s` (column `time_s`) tilts about the x and y axes of the base's frame, and a shift along its z axis.

    The tilts are about the base's origin.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"tilt_x_rad": 5e-3, "tilt_y_rad": 5e-3, "z_mm": 20.0}
    has_either_sign = True
    acts_at = ("base",)
    where: str = "base"
    tilt_x_rad: float = 1.0e-3
    tilt_y_rad: float = 1.0e-3
    z_mm: float = 3.0
    time_s: float = 0.0

    def draw_shape(self, data: DrawContext, rng: np.random.Generator) -> Effect:
        return replace(self, time_s=step_time_s(data, rng))

    def bends(self, body: Body) -> Sequence[Bend]:
        after = (body.column("time_s") > self.time_s).astype(float)[:, None]
        tilt = after * np.array([self.tilt_x_rad, self.tilt_y_rad, 0.0])
        return (Bend(0, np.zeros_like(tilt), tilt, after * np.array([0.0, 0.0, self.z_mm])),)
