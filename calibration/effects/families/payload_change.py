"""A joint that deflects under a payload."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, JointFamily, Settings
from calibration.effects.context import EffectContext
from calibration.effects.load_shapes import (
    UNIT,
    LoadShapes,
    UncertainLoadFamily,
    load_columns,
    load_variants,
    part_coefficients,
    part_names,
    shapes_by_design,
)
from calibration.observations import Floats

_SIGMA_RAD = 1e-3  # at the largest torque, as for `joint_compliance`
_BOUND_RAD = 20e-3
_TORQUE = "torque_Nm"
_PAYLOAD_KG = 100.0  # payload for which the load shapes are computed
_COLLINEAR = 1e-9


class PayloadChange(UncertainLoadFamily, JointFamily):
    """Deflection by the payload's part of the joint's load only.

    The mass of the payload is measured. Variants include the uncertainty due to its centre of gravity.
    """

    name = "payload_change"
    equation = "d_theta = compliance * (torque with payload_kg - torque without)"
    source = "ICIC 2020, Eqs. 16, 17, for the payload's part of the load"
    confused_with = ("joint_compliance", "base_step", "boom_droop")
    revealed_by = "the same poses with and without the payload, alternating"
    load_kind = "weights"
    kind = "revolute"

    def needs(self, where: str) -> str:
        del where
        return "the column payload_kg, and a payload among the masses in the rig file"

    def known(self, context: EffectContext, where: str) -> NDArray[np.bool_]:
        del where
        carries = any(mass.payload for mass in context.rig.masses)
        return np.isfinite(context.extra("payload_kg")) & carries

    def variants(self, context: EffectContext, where: str) -> tuple[Settings, ...]:
        known, torque = self.known(context, where), context.greatest_torque(where)
        if torque == 0.0 or not known.any() or np.ptp(context.extra("payload_kg")[known]) == 0.0:
            return ()
        usual = float(np.sqrt(np.mean(context.payload_torque(where)[known] ** 2)))
        if not usual > _COLLINEAR * torque:
            return ()
        variants = load_variants(_shapes(context, where), _SIGMA_RAD / torque)
        return tuple({**settings, _TORQUE: usual} for settings in variants)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if settings.get(_TORQUE, 0.0) <= 0.0:
            raise ValueError(f"the setting {_TORQUE}, the payload's RMS torque in the training rows, must be above 0")
        return ("compliance_rad_per_Nm", *part_names(_of_parts(settings)))

    def coefficients(self, context: EffectContext, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        torque = context.greatest_torque(where)
        most = _BOUND_RAD / torque
        return (
            Coefficient("compliance_rad_per_Nm", UNIT, _SIGMA_RAD / torque, 0.0, most),
            *part_coefficients(_of_parts(settings), most),
        )

    def columns(self, context: EffectContext, where: str, settings: Settings) -> Floats:
        columns = load_columns(
            context.payload_torque(where),
            _of_parts(settings),
            lambda: _shapes(context, where),
            lambda: context.payload_parts(where),
        )
        return np.degrees(columns)

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings[_TORQUE])) ** 2


def _of_parts(settings: Settings) -> Settings:
    return {name: value for name, value in settings.items() if name != _TORQUE}


def _shapes(context: EffectContext, where: str) -> LoadShapes:
    """Return the load shapes due to the payload's uncertain centre of gravity; its mass is measured."""

    def of(volume: EffectContext) -> tuple[Floats, Floats]:
        extra = {"payload_kg": np.full(len(volume), _PAYLOAD_KG)}
        carrying = replace(volume, observations=replace(volume.observations, extra=extra))
        load, parts = carrying.payload_torque(where), carrying.payload_parts(where)
        share = load @ parts / max(float(load @ load), np.finfo(np.float64).tiny)
        left = np.abs(parts - load[:, None] * share).max(axis=0)
        return load, np.where(left > _COLLINEAR * np.abs(load).max(), parts, 0.0)

    return shapes_by_design(context, f"payload at {where}", of)


FAMILY = PayloadChange()
