"""Errors of joints that are in no library in any form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats, boom_stroke, warming
from simulators.hydraulics import DEAD_BAND_MA, RATED_BAR, VALVE_JOINTS


@dataclass(frozen=True)
class Creep(Effect):
    """A joint that keeps yielding under its load, quickly at first: hoses, seals and rubber.

    d_theta = c torque log(1 + dwell / tau), dwell the column `dwell_s`, with the torque in the deflected posture.

    Attributes:
        rad_per_Nm: c.
        tau_s: tau.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_per_Nm": 5e-3}
    bounded_at = "largest_load"
    needs_load = True
    acts_at = ("revolute",)
    positive = ("tau_s",)
    rad_per_Nm: float = 2e-9  # noqa: N815 - the unit is N m
    tau_s: float = 10.0

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad_per_Nm * body.torque(self.where) * np.log1p(body.column("dwell_s") / self.tau_s)
        return change


@dataclass(frozen=True)
class StickSlipRate(Effect):
    """A joint that is dragged back while it moves, by nearly the same angle at any speed.

    d_theta = e tanh(rate / v), rate the column `<joint>_rate`; zero at rest.

    Attributes:
        rad: e.
        deg_per_s: v.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad": 6e-3}
    acts_at = ("revolute",)
    positive = ("deg_per_s",)
    rad: float = 1.5e-3
    deg_per_s: float = 0.15

    def joint_change(self, body: Body) -> Floats:
        change: Floats = self.rad * np.tanh(body.column(f"{self.where}_rate") / self.deg_per_s)
        return change


@dataclass(frozen=True)
class ThermalCross(Effect):
    """A telescope that jams when warm: its joint has an error proportional to temperature times extension.

    d_theta = e (T - T0) / 10 K * L / upper limit, T the column `temperature_degC`, L the stroke as read.

    Attributes:
        rad_at_10K: e.
        at_degC: T0; None for the mean of the given rows.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_at_10K": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    rad_at_10K: float = 1.0e-3  # noqa: N815 - the unit is K
    at_degC: float | None = None  # noqa: N815 - the unit is degC

    def check(self, rig: Rig) -> None:
        super().check(rig)
        boom_stroke(rig)

    def joint_change(self, body: Body) -> Floats:
        stroke = boom_stroke(body.rig)
        out = body.read[stroke] / body.rig.joint(stroke).limits[1]
        change: Floats = self.rad_at_10K * warming(body, self.at_degC) / 10.0 * out
        return change


@dataclass(frozen=True)
class CrossLaw(Effect):
    """A hose or linkage that one joint drags along another: the law depends on both joints.

    d_theta = e sin(3 phi) (L / mid-stroke - 1), with readings phi of the previous revolute joint and L of the stroke.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    rad: float = 1.0e-3

    def check(self, rig: Rig) -> None:
        super().check(rig)
        boom_stroke(rig)
        self._joint_before(rig)

    def _joint_before(self, rig: Rig) -> str:
        turning = [joint.name for joint in rig.joints if joint.kind == "revolute"]
        place = turning.index(self.where)
        if place == 0:
            raise ValueError(f"{self.family}@{self.where}: there is no revolute joint before this one")
        return turning[place - 1]

    def joint_change(self, body: Body) -> Floats:
        other, stroke = self._joint_before(body.rig), boom_stroke(body.rig)
        beside = body.read[stroke] / (sum(body.rig.joint(stroke).limits) / 2) - 1.0
        change: Floats = self.rad * np.sin(3.0 * body.read[other]) * beside
        return change


@dataclass(frozen=True)
class ValveCurrentError(Effect):
    """Oil pressure in a moving actuator winds up its mounting, which the encoder does not measure.

    d_theta = e * sign(i) * s^2 / (1 + s^2) * pump_bar / 200 bar, with s = (|i| - dead band) / knee, never below 0.

    Opening the spool meters oil into the chamber that pushes. Leakage past the piston seals grows with the pressure
    drop, so the drop settles where leakage and seal friction balance the metered flow. It is small at first, because a
    spool's fine-control notches open with the square of its stroke, and finally reaches the pump's pressure. This force
    bends cylinder pins and brackets between the encoder and the link. The joint's true value is therefore wrong by an
    amount that depends on the valve's current and the pump's pressure, and that the encoder does not measure.

    Needs the columns `<valve>_valve_mA` of the joint's valve and `pump_bar`.

    Attributes:
        rad_at_rated: e, the error far above the knee at rated pressure.
        knee_mA: current above the dead band at which half of e is reached.
    """

    amplitudes: ClassVar[Mapping[str, float]] = {"rad_at_rated": 6e-3}
    has_either_sign = True
    acts_at = ("revolute",)
    positive = ("knee_mA",)
    rad_at_rated: float = 2e-3
    knee_mA: float = 25.0  # noqa: N815 - the unit is mA

    def check(self, rig: Rig) -> None:
        super().check(rig)
        if self._valve() is None:
            known = ", ".join(VALVE_JOINTS.values())
            raise ValueError(f"{self.family}@{self.where}: no valve current is measured there; known: {known}")

    def _valve(self) -> str | None:
        return next((valve for valve, joint in VALVE_JOINTS.items() if joint == self.where), None)

    def joint_change(self, body: Body) -> Floats:
        current = body.column(f"{self._valve()}_valve_mA")
        opening = np.maximum(np.abs(current) - DEAD_BAND_MA, 0.0) / self.knee_mA
        share = opening**2 / (1.0 + opening**2)
        pressure = body.column("pump_bar") / RATED_BAR
        change: Floats = self.rad_at_rated * np.sign(current) * share * pressure
        return change
