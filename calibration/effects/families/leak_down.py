"""A cylinder that sinks while the machine stands still."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.observations import Floats

_DWELL, _WITH_LOAD = "dwell_s", "with_load"


class LeakDown(JointFamily):
    """The joint sinks with the time since the last motion, in addition to the motion that its encoder measures.

    Sinking either lowers the joint's value, or follows the direction of its load. On many machines a sinking cylinder
    raises the value, and a joint that swings over its dead centre sinks to either side. The data select the variant.
    """

    name = "leak_down"
    equation = "d_theta = -rate * dwell (column dwell_s), or rate * dwell * sign(torque)"
    source = "internal leakage of cylinders and load-holding valves, a drift test of lifting machines"
    confused_with = ("base_settlement", "joint_compliance")
    revealed_by = "standing still in one pose and measuring immediately, after one minute and after ten"
    fixed = (Coefficient("rad_per_s", "rad/s", 1e-5, 0.0, 5e-5),)
    column = "dwell_s"
    kind = "revolute"

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        dwell_s = context.extra(self.column)[self.known(context, where)]
        usual = float(np.sqrt(np.mean(dwell_s**2))) if len(dwell_s) else 0.0
        if not usual > 0.0:
            return ()
        falls, sinks = ({_DWELL: usual, _WITH_LOAD: share} for share in (0.0, 1.0))
        if not context.rig.masses:
            return (falls,)
        if context.greatest_torque(where) == 0.0:
            return ()
        same = np.array_equal(self.columns(context, where, falls), self.columns(context, where, sinks))
        return (falls,) if same else (falls, sinks)

    def form(self, settings: Settings) -> str:
        return "with the load" if settings[_WITH_LOAD] else ""

    def check_settings(self, settings: Settings) -> None:
        if set(settings) != {_DWELL, _WITH_LOAD} or settings[_DWELL] <= 0.0 or settings[_WITH_LOAD] not in (0.0, 1.0):
            raise ValueError(
                f"the settings are {_DWELL}, the RMS dwell of the training rows, and {_WITH_LOAD}, 1 if the joint "
                "sinks in the direction of the load, else 0"
            )

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        side = np.sign(np.nan_to_num(context.torque(where))) if settings[_WITH_LOAD] else -1.0
        return np.degrees(side * np.nan_to_num(context.extra(self.column)))[:, None]

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings[_DWELL])) ** 2


FAMILY = LeakDown()
