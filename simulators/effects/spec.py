"""Effects as text: `joint_compliance@theta4:compliance_rad_per_Nm=2e-8,boom_droop@boom`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields

from simulators.effects.angle_scale import AngleScale
from simulators.effects.backlash import Backlash
from simulators.effects.base import Effect
from simulators.effects.base_settlement import BaseSettlement
from simulators.effects.base_step import BaseStep
from simulators.effects.boom_droop import BoomDroop
from simulators.effects.clock_drift import ClockDrift
from simulators.effects.cylinder_compression import CylinderCompression
from simulators.effects.encoder_harmonic import EncoderHarmonic
from simulators.effects.gear_mesh import GearMesh
from simulators.effects.gravity_flip_play import GravityFlipPlay
from simulators.effects.joint_compliance import JointCompliance
from simulators.effects.joint_error_map import JointErrorMap
from simulators.effects.latency import Latency
from simulators.effects.leak_down import LeakDown
from simulators.effects.linkage_coupling import LinkageCoupling
from simulators.effects.load_hysteresis import LoadHysteresis
from simulators.effects.outside import (
    BaseRocking,
    Creep,
    CrossLaw,
    PrismMastBend,
    StickSlipRate,
    ThermalCross,
    TwistByReach,
)
from simulators.effects.pad_play import PadPlay
from simulators.effects.payload_change import PayloadChange
from simulators.effects.prism_constant import PrismConstant
from simulators.effects.prism_incidence import PrismIncidence
from simulators.effects.solar_bow import SolarBow
from simulators.effects.station_scale import StationScale
from simulators.effects.stiffening_compliance import StiffeningCompliance
from simulators.effects.thermal_expansion import ThermalExpansion
from simulators.effects.transducer_cumulative import TransducerCumulative
from simulators.effects.transducer_index_jump import TransducerIndexJump
from simulators.effects.transducer_quadratic import TransducerQuadratic
from simulators.effects.transducer_scale import TransducerScale
from simulators.effects.valve_current_error import ValveCurrentError

_LIBRARY: tuple[type[Effect], ...] = (
    JointCompliance,
    BoomDroop,
    PadPlay,
    Backlash,
    GravityFlipPlay,
    LoadHysteresis,
    EncoderHarmonic,
    JointErrorMap,
    AngleScale,
    TransducerScale,
    TransducerQuadratic,
    TransducerIndexJump,
    TransducerCumulative,
    ThermalExpansion,
    SolarBow,
    BaseSettlement,
    BaseStep,
    PayloadChange,
    CylinderCompression,
    LeakDown,
    Latency,
    ClockDrift,
    StationScale,
    PrismConstant,
    PrismIncidence,
    LinkageCoupling,
)
# Particular forms of what the library has in general: teeth make an error map, a reducer is compliant.
_PARTICULAR: tuple[type[Effect], ...] = (GearMesh, StiffeningCompliance)
_OUTSIDE: tuple[type[Effect], ...] = (
    BaseRocking,
    Creep,
    CrossLaw,
    PrismMastBend,
    StickSlipRate,
    ThermalCross,
    TwistByReach,
    ValveCurrentError,
)

LIBRARY: Mapping[str, type[Effect]] = {kind.family: kind for kind in _LIBRARY}
"""Effects that a library of physical effects names."""

OUTSIDE: Mapping[str, type[Effect]] = {kind.family: kind for kind in _OUTSIDE}
"""Effects that it does not, in whatever form."""

FAMILIES: Mapping[str, type[Effect]] = {
    **LIBRARY,
    **{kind.family: kind for kind in _PARTICULAR},
    **OUTSIDE,
}


def parse_effects(text: str) -> tuple[Effect, ...]:
    """Effects from `FAMILY@WHERE[:NAME=VALUE[:NAME=VALUE...]]`, separated by commas; "" is none.

    Raises:
        ValueError: unknown family or coefficient, or a value that is no finite number; the message says what is known.
    """
    return tuple(_parse_one(part.strip()) for part in text.split(",") if part.strip())


def _parse_one(part: str) -> Effect:
    head, *settings = part.split(":")
    family, at, where = head.partition("@")
    kind = FAMILIES.get(family)
    if kind is None:
        raise ValueError(f"unknown effect {family!r}; known: {', '.join(sorted(FAMILIES))}")
    if not at or not where:
        raise ValueError(f"{part!r}: say where, as in {family}@theta4")
    known = {f.name: f.type for f in fields(kind) if f.name != "where"}
    values: dict[str, float | int] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        if name not in known:
            raise ValueError(f"{part!r}: {family} has no {name!r}; it has {', '.join(known)}")
        try:
            number = float(value)
        except ValueError:
            raise ValueError(f"{part!r}: {value!r} is not a number") from None
        if not math.isfinite(number):
            raise ValueError(f"{part!r}: {value!r} is not a finite number")
        values[name] = int(number) if known[name] == "int" else number
    return kind(where=where, **values)
