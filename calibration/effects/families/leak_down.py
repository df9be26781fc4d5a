"""A cylinder that sinks while the machine stands."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.observations import Floats

_DWELL, _WITH_LOAD = "dwell_s", "with_load"


class LeakDown(JointFamily):
    """The joint goes down with the time since the last motion, beyond what its encoder sees.

    Down is where its value falls, or where its load goes: on many machines a cylinder that sinks makes the value rise,
    and a joint that swings over its dead centre sinks to either side. The data choose.
    """

    name: ClassVar[str] = "leak_down"
    equation: ClassVar[str] = "d_theta = -rate * dwell (column dwell_s), or rate * dwell * sign(torque)"
    source: ClassVar[str] = "internal leakage of cylinders and load-holding valves, a drift test of lifting machines"
    confused_with: ClassVar[tuple[str, ...]] = ("base_settlement", "joint_compliance")
    revealed_by: ClassVar[str] = "standing still in one pose and measuring at once, after a minute and after ten"
    column: ClassVar[str] = "dwell_s"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        dwell_s = situation.extra(self.column)[self.known(situation, where)]
        usual = float(np.sqrt(np.mean(dwell_s**2))) if len(dwell_s) else 0.0
        if not usual > 0.0:
            return ()
        falls, sinks = ({_DWELL: usual, _WITH_LOAD: share} for share in (0.0, 1.0))
        if not situation.rig.masses:
            return (falls,)
        if situation.greatest_torque(where) == 0.0:
            return ()
        same = np.array_equal(self.columns(situation, where, falls), self.columns(situation, where, sinks))
        return (falls,) if same else (falls, sinks)

    def form(self, settings: Settings) -> str:
        return "with the load" if settings[_WITH_LOAD] else ""

    def names(self, settings: Settings) -> tuple[str, ...]:
        if set(settings) != {_DWELL, _WITH_LOAD} or settings[_DWELL] <= 0.0 or settings[_WITH_LOAD] not in (0.0, 1.0):
            raise ValueError(
                f"the settings are {_DWELL}, the usual dwell of the training rows, and {_WITH_LOAD}, whether it goes "
                "where the load does"
            )
        return ("rad_per_s",)

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        del situation, where, settings
        return (Coefficient("rad_per_s", "rad/s", 1e-5, 0.0, 5e-5),)

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        side = np.sign(np.nan_to_num(situation.torque(where))) if settings[_WITH_LOAD] else -1.0
        return np.degrees(side * np.nan_to_num(situation.extra(self.column)))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings[_DWELL])) ** 2


FAMILY = LeakDown()
