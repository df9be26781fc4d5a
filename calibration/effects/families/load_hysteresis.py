"""Friction that grows with the load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.effects.load_shapes import (
    UNIT,
    UncertainLoadFamily,
    gravity_shapes,
    load_columns,
    load_variants,
    part_coefficients,
    part_names,
)
from calibration.observations import Floats

_SIGMA_RAD = 0.5e-3  # at the largest torque
_BOUND_RAD = 5e-3


class LoadHysteresis(UncertainLoadFamily, JointFamily):
    """Friction holds back one side of a compliant drive, in proportion to the load.

    If this is the encoder's side, the joint is further along in the direction of its last motion. With an encoder at
    the motor the joint lags, and the coefficient is negative. As for a compliance, variants include the uncertainty of
    the load's course due to uncertain masses.
    """

    name = "load_hysteresis"
    equation = "d_theta = k * direction of the last motion * |torque|; k < 0: the joint lags"
    source = "Coulomb friction in loaded bearings and gears (Armstrong-Helouvry et al. 1994)"
    confused_with = ("backlash", "gravity_flip_play")
    revealed_by = "approaching the same pose from both sides, at low and at high load"
    load_kind = "torque"
    kind = "revolute"

    def needs(self, where: str) -> str:
        return f"the column {where}_dir, and masses in the rig file or the column {where}_Nm"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        return np.isfinite(context.extra(f"{where}_dir")) & np.isfinite(context.torque(where))

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        torque = context.greatest_torque(where)
        if torque == 0.0:
            return ()
        if context.is_torque_measured(where):
            return ({},)
        return load_variants(gravity_shapes(context, where), _SIGMA_RAD / torque)

    def names(self, settings: Settings) -> tuple[str, ...]:
        return ("rad_per_Nm", *part_names(settings))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        torque = context.greatest_torque(where)
        most = _BOUND_RAD / torque
        return (
            Coefficient("rad_per_Nm", UNIT, _SIGMA_RAD / torque, -most, most),
            *part_coefficients(settings, most),
        )

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        load = np.nan_to_num(context.torque(where))
        columns = load_columns(
            load, settings, lambda: gravity_shapes(context, where), lambda: context.torque_parts(where)
        )
        side = np.nan_to_num(context.extra(f"{where}_dir")) * np.sign(load)
        return np.degrees(side[:, None] * columns)

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Return the mean square for a load that varies as a sine, up to the largest load in the work volume."""
        del settings
        most = _SIGMA_RAD / float(plausible[0])  # inverse of `coefficients`
        return 0.5 * float(np.degrees(most * values[0])) ** 2


FAMILY = LoadHysteresis()
