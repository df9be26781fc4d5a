"""Physical effects that the simulated machine can hide: one file each, written for the simulator alone."""

from __future__ import annotations

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
from simulators.effects.pad_play import PadPlay
from simulators.effects.payload_change import PayloadChange
from simulators.effects.prism_constant import PrismConstant
from simulators.effects.prism_incidence import PrismIncidence
from simulators.effects.solar_bow import SolarBow
from simulators.effects.spec import parse_effects
from simulators.effects.station_scale import StationScale
from simulators.effects.stiffening_compliance import StiffeningCompliance
from simulators.effects.thermal_expansion import ThermalExpansion
from simulators.effects.transducer_cumulative import TransducerCumulative
from simulators.effects.transducer_index_jump import TransducerIndexJump
from simulators.effects.transducer_quadratic import TransducerQuadratic
from simulators.effects.transducer_scale import TransducerScale
from simulators.effects.valve_current_error import ValveCurrentError

__all__ = [
    "AngleScale",
    "Backlash",
    "BaseSettlement",
    "BaseStep",
    "BoomDroop",
    "ClockDrift",
    "CylinderCompression",
    "Effect",
    "EncoderHarmonic",
    "GearMesh",
    "GravityFlipPlay",
    "JointCompliance",
    "JointErrorMap",
    "Latency",
    "LeakDown",
    "LinkageCoupling",
    "LoadHysteresis",
    "PadPlay",
    "PayloadChange",
    "PrismConstant",
    "PrismIncidence",
    "SolarBow",
    "StationScale",
    "StiffeningCompliance",
    "ThermalExpansion",
    "TransducerCumulative",
    "TransducerIndexJump",
    "TransducerQuadratic",
    "TransducerScale",
    "ValveCurrentError",
    "parse_effects",
]
