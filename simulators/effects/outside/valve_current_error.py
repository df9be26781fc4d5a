"""Oil pressure in a moving actuator winds up its mounting, beyond the encoder's reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.rig.description import Rig
from simulators.effects.base import Body, Effect, Floats
from simulators.hydraulics import DEAD_BAND_MA, RATED_BAR, VALVE_JOINTS


@dataclass(frozen=True)
class ValveCurrentError(Effect):
    """d_theta = e * sign(i) * s^2 / (1 + s^2) * pump_bar / 200 bar, with s = (|i| - dead band) / knee, never below 0.

    Opening the spool meters oil into the chamber that pushes. What leaks past the piston seals grows with the pressure
    drop, so the drop settles where leakage and seal friction take up the metered flow: small at first, as a spool's
    fine-control notches open with the square of its stroke, and in the end the pump's pressure itself. That force
    bends cylinder pins and brackets that lie between the encoder and the link. The joint's true value is therefore off
    by an amount that the valve's current and the pump's pressure tell and the encoder does not see.

    Needs the columns `<valve>_valve_mA` of the joint's valve and `pump_bar`.

    Attributes:
        rad_at_rated: e, far above the knee at rated pressure.
        knee_mA: current past the dead band where half of it is reached.
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
            raise ValueError(f"{self.family}@{self.where}: no valve's current is measured there; known: {known}")

    def _valve(self) -> str | None:
        return next((valve for valve, joint in VALVE_JOINTS.items() if joint == self.where), None)

    def joint_change(self, body: Body) -> Floats:
        current = body.column(f"{self._valve()}_valve_mA")
        opening = np.maximum(np.abs(current) - DEAD_BAND_MA, 0.0) / self.knee_mA
        share = opening**2 / (1.0 + opening**2)
        pressure = body.column("pump_bar") / RATED_BAR
        change: Floats = self.rad_at_rated * np.sign(current) * share * pressure
        return change
