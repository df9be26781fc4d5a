"""A machine that leans as measured by an inclinometer on it: on soft ground, or as the boom bends its mast."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, Settings, SizedFamily, check_sizes, sizes
from calibration.effects.context import EffectContext
from calibration.observations import Floats
from calibration.rig.description import Rig

_TILT = "tilt"
_AXES = ("_x", "_y")
_RAD_PER_DEG = math.pi / 180.0
_LEAST_DEG = 1e-3  # smallest range of readings; less is the last digit of an inclinometer
_MOST_DEG = 5.0  # largest standard deviation; an inclinometer with more is on a part that a joint turns
_PIVOT = "pivot"
_PIVOTS = (0.0, 1.0 / 3.0, 0.5, 1.0)  # as shares of the lift's height: foot, bent by a force, bent by a moment, top
_MEANS = ("mean_x_deg", "mean_y_deg")


class MeasuredTilt(SizedFamily):
    """The machine turns about its level axes by the deviation of an inclinometer's two readings from their mean.

    An inclinometer is a pair of signals of the rig file in degrees with `tilt` in their names, such as `tilt_mast_x`
    and `tilt_mast_y`; the name without `_x` is the place. It must be on a part that no joint turns: the carrier, or a
    lifted mast. Its mounting need not be known, as each reading may turn the machine about both axes. If the first
    joint is a lift, the mast may bend, so that the pivot is above its foot.
    """

    name = "measured_tilt"
    equation = "turns about the base's level x and y axes = 2 x 2 matrix * (readings - their mean in the training)"
    source = "rigid rotation by small angles; cantilever mast under an end force or an end moment (Euler-Bernoulli)"
    confused_with = ("base_compliance", "base_settlement", "base_step")
    revealed_by = "the boom far out to all sides, and the carrier set down again on different ground"
    fixed = tuple(
        Coefficient(
            f"about_{axis}_by_{reading}_rad_per_deg", "rad/deg", _RAD_PER_DEG, -2 * _RAD_PER_DEG, 2 * _RAD_PER_DEG
        )
        for reading in "xy"
        for axis in "xy"
    )
    moves_machine = False

    def places(self, rig: Rig) -> tuple[str, ...]:
        in_degrees = {signal.name for signal in (*rig.channels, *rig.signals) if signal.unit == "deg"}
        tilts = {name for name in in_degrees.difference(rig.joint_names) if _TILT in name}
        stems = sorted(name.removesuffix(_AXES[0]) for name in tilts if name.endswith(_AXES[0]))
        return tuple(stem for stem in stems if stem + _AXES[1] in tilts)

    def needs(self, where: str) -> str:
        return "the columns " + " and ".join(_columns(where))

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(_readings(context, where)).all(axis=1), dtype=np.bool_)

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known = self.known(context, where)
        readings = _readings(context, where)[known]
        if not len(readings) or np.ptp(readings, axis=0).max() < _LEAST_DEG or readings.std(axis=0).max() > _MOST_DEG:
            return ()
        means = _means(readings)
        pivots = _PIVOTS if context.rig.joints[0].kind == "prismatic" else _PIVOTS[:1]
        forms = ({**means, _PIVOT: pivot} for pivot in pivots)
        return tuple({**form, **sizes(_shift_mm(context, where, form)[known])} for form in forms)

    def at_new_setups(self, context: EffectContext, where: str, settings: Settings) -> Settings:
        """Replace the means by those at the new set-ups, whose bases include the mean tilt, even of several degrees."""
        known = self.known(context, where)
        return {**settings, **_means(_readings(context, where)[known])} if known.any() else settings

    def form(self, settings: Settings) -> str:
        return f"about a point at {settings[_PIVOT]:.2f} of the lift's height" if settings[_PIVOT] else ""

    def check_settings(self, settings: Settings) -> None:
        check_sizes(settings, (*_MEANS, _PIVOT), len(self.fixed))
        if not all(math.isfinite(settings[name]) for name in (*_MEANS, _PIVOT)):
            raise ValueError(f"the settings {', '.join((*_MEANS, _PIVOT))} must be finite numbers")

    def shift_mm(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        return _shift_mm(context, where, settings)


def _columns(where: str) -> tuple[str, ...]:
    return tuple(f"{where}{axis}_deg" for axis in _AXES)


def _readings(context: EffectContext, where: str) -> Floats:
    """Return the inclinometer's readings (n, 2), deg."""
    return np.column_stack([context.extra(column) for column in _columns(where)])


def _means(readings: Floats) -> dict[str, float]:
    """Return the settings with the means of readings (n, 2)."""
    return dict(zip(_MEANS, readings.mean(axis=0).tolist(), strict=True))


def _shift_mm(context: EffectContext, where: str, settings: Settings) -> Floats:
    """Return the displacement (n, 3, 4), mm per rad/deg."""
    deviation_deg = np.nan_to_num(_readings(context, where) - [settings[name] for name in _MEANS])
    turned_mm = context.mast_tilt_mm(settings[_PIVOT])
    shift: Floats = np.concatenate([turned_mm * deviation_deg[:, axis, None, None] for axis in range(2)], axis=2)
    return shift


FAMILY = MeasuredTilt()
