"""A cylinder that sinks while the machine stands."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.observations import Floats


class LeakDown(JointFamily):
    """The joint goes down with the time since the last motion, beyond what its encoder sees."""

    name: ClassVar[str] = "leak_down"
    equation: ClassVar[str] = "d_theta = -rate * dwell (column dwell_s); it lowers the joint's value"
    source: ClassVar[str] = "internal leakage of cylinders and load-holding valves, a drift test of lifting machines"
    confused_with: ClassVar[tuple[str, ...]] = ("base_settlement", "joint_compliance")
    revealed_by: ClassVar[str] = "standing still in one pose and measuring at once, after a minute and after ten"
    column: ClassVar[str] = "dwell_s"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        dwell_s = situation.extra("dwell_s")[self.known(situation, where)]
        usual = float(np.sqrt(np.mean(dwell_s**2))) if len(dwell_s) else 0.0
        carries = situation.greatest_torque(where) > 0.0 or not situation.rig.masses
        return ({"dwell_s": usual},) if carries and usual > 0.0 else ()

    def names(self, settings: Settings) -> tuple[str, ...]:
        if set(settings) != {"dwell_s"} or settings["dwell_s"] <= 0.0:
            raise ValueError("the only setting is dwell_s, the usual dwell of the training rows")
        return ("rad_per_s",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("rad_per_s", "rad/s", 1e-5, 0.0, 5e-5),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        del where, settings
        return -np.degrees(np.nan_to_num(situation.extra("dwell_s")))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings["dwell_s"])) ** 2


FAMILY = LeakDown()
