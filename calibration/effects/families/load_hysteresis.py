"""Friction that grows with the load."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.effects.load_shapes import (
    UNIT,
    OfUncertainLoad,
    gravity_shapes,
    load_variants,
    part_coefficients,
    part_names,
    shape_columns,
)
from calibration.observations import Floats

_SIGMA_RAD = 0.5e-3  # at the largest torque
_BOUND_RAD = 5e-3


class LoadHysteresis(OfUncertainLoad, JointFamily):
    """Friction holds one side of a yielding drive back by the load.

    Where it is the encoder's, the joint is further along its last motion. Behind an encoder at the motor the joint
    lags, and the coefficient is negative. As for a compliance, variants have what uncertain masses leave open.
    """

    name: ClassVar[str] = "load_hysteresis"
    equation: ClassVar[str] = "d_theta = k * direction of the last motion * |torque|; k < 0: the joint lags"
    source: ClassVar[str] = "Coulomb friction in loaded bearings and gears (Armstrong-Helouvry et al. 1994)"
    confused_with: ClassVar[tuple[str, ...]] = ("backlash", "gravity_flip_play")
    revealed_by: ClassVar[str] = "coming to the same pose from both sides, under little load and under great load"
    goes_with: ClassVar[Literal["", "torque", "weights"]] = "torque"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def needs(self, where: str) -> str:
        return f"the column {where}_dir, and masses in the rig file or the column {where}_Nm"

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        return np.isfinite(situation.extra(f"{where}_dir")) & np.isfinite(situation.torque(where))

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        torque = situation.greatest_torque(where)
        if torque == 0.0:
            return ()
        if situation.is_torque_measured(where):
            return ({},)
        return load_variants(gravity_shapes(situation, where), _SIGMA_RAD / torque)

    def names(self, settings: Settings) -> tuple[str, ...]:
        return ("rad_per_Nm", *part_names(settings))

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        torque = situation.greatest_torque(where)
        most = _BOUND_RAD / torque
        return (
            Coefficient("rad_per_Nm", UNIT, _SIGMA_RAD / torque, -most, most),
            *part_coefficients(settings, most),
        )

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        load = np.nan_to_num(situation.torque(where))
        columns = [load[:, None]]
        if part_names(settings):
            shapes = gravity_shapes(situation, where)
            columns.append(shape_columns(shapes, load, situation.torque_parts(where), settings))
        side = np.nan_to_num(situation.extra(f"{where}_dir")) * np.sign(load)
        return np.degrees(side[:, None] * np.hstack(columns))

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        """Of a load that goes as a sine, up to the largest one in the work volume."""
        del settings
        most = _SIGMA_RAD / float(plausible[0])  # as `coefficients` has it
        return 0.5 * float(np.degrees(most * values[0])) ** 2


FAMILY = LoadHysteresis()
