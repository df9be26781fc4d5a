"""A joint that gives way to a payload."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Coefficient, JointFamily, Settings, Situation
from calibration.effects.load_shapes import (
    UNIT,
    LoadShapes,
    OfUncertainLoad,
    load_variants,
    part_coefficients,
    part_names,
    shape_columns,
    shapes_by_design,
)
from calibration.observations import Floats

_SIGMA_RAD = 1e-3  # at the largest torque, as of a compliance
_BOUND_RAD = 20e-3
_TORQUE = "torque_Nm"
_PAYLOAD_KG = 100.0  # whose load has the shapes
_COLLINEAR = 1e-9


class PayloadChange(OfUncertainLoad, JointFamily):
    """Deflection by what the payload adds to the joint's load, and by nothing else.

    How heavy the payload is has been measured; variants have what its centre of gravity leaves open.
    """

    name: ClassVar[str] = "payload_change"
    equation: ClassVar[str] = "d_theta = compliance * (torque with payload_kg - torque without)"
    source: ClassVar[str] = "ICIC 2020, Eqs. 16, 17, for the payload's part of the load"
    confused_with: ClassVar[tuple[str, ...]] = ("joint_compliance", "base_step", "boom_droop")
    revealed_by: ClassVar[str] = "the same poses with the payload and without it, in turns"
    goes_with: ClassVar[Literal["", "torque", "weights"]] = "weights"
    kind: ClassVar[Literal["revolute", "prismatic"]] = "revolute"

    def needs(self, where: str) -> str:
        del where
        return "the column payload_kg, and a payload among the masses in the rig file"

    def known(self, situation: Situation, where: str) -> NDArray[np.bool_]:
        del where
        carries = any(mass.payload for mass in situation.rig.masses)
        return np.isfinite(situation.extra("payload_kg")) & carries

    def variants(self, situation: Situation, where: str) -> tuple[Settings, ...]:
        known, torque = self.known(situation, where), situation.greatest_torque(where)
        if torque == 0.0 or not known.any() or np.ptp(situation.extra("payload_kg")[known]) == 0.0:
            return ()
        usual = float(np.sqrt(np.mean(situation.payload_torque(where)[known] ** 2)))
        if not usual > _COLLINEAR * torque:
            return ()
        variants = load_variants(_shapes(situation, where), _SIGMA_RAD / torque)
        return tuple({**settings, _TORQUE: usual} for settings in variants)

    def names(self, settings: Settings) -> tuple[str, ...]:
        if settings.get(_TORQUE, 0.0) <= 0.0:
            raise ValueError(f"the setting {_TORQUE} must be there, the payload's usual torque in the training rows")
        return ("compliance_rad_per_Nm", *part_names(_of_parts(settings)))

    def coefficients(self, situation: Situation, where: str, settings: Settings) -> tuple[Coefficient, ...]:
        torque = situation.greatest_torque(where)
        most = _BOUND_RAD / torque
        return (
            Coefficient("compliance_rad_per_Nm", UNIT, _SIGMA_RAD / torque, 0.0, most),
            *part_coefficients(_of_parts(settings), most),
        )

    def columns(self, situation: Situation, where: str, settings: Settings) -> Floats:
        load, own = situation.payload_torque(where), _of_parts(settings)
        columns = [load[:, None]]
        if part_names(own):
            columns.append(shape_columns(_shapes(situation, where), load, situation.payload_parts(where), own))
        return np.degrees(np.hstack(columns))

    def unknown_variance(self, values: Floats, plausible: Floats, settings: Settings) -> float:
        del plausible
        return float(np.degrees(values[0] * settings[_TORQUE])) ** 2


def _of_parts(settings: Settings) -> Settings:
    return {name: value for name, value in settings.items() if name != _TORQUE}


def _shapes(situation: Situation, where: str) -> LoadShapes:
    """What the payload's centre of gravity leaves open; how heavy it is has been measured."""

    def of(volume: Situation) -> tuple[Floats, Floats]:
        extra = {"payload_kg": np.full(len(volume), _PAYLOAD_KG)}
        carrying = replace(volume, observations=replace(volume.observations, extra=extra))
        load, parts = carrying.payload_torque(where), carrying.payload_parts(where)
        share = load @ parts / max(float(load @ load), np.finfo(np.float64).tiny)
        left = np.abs(parts - load[:, None] * share).max(axis=0)
        return load, np.where(left > _COLLINEAR * np.abs(load).max(), parts, 0.0)

    return shapes_by_design(situation, f"payload at {where}", of)


FAMILY = PayloadChange()
