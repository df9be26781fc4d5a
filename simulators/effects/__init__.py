"""Physical effects that the simulated machine can hide: one file each, written for the simulator alone."""

from __future__ import annotations

from simulators.effects.backlash import Backlash
from simulators.effects.base import Effect
from simulators.effects.boom_droop import BoomDroop
from simulators.effects.encoder_harmonic import EncoderHarmonic
from simulators.effects.joint_compliance import JointCompliance
from simulators.effects.load_hysteresis import LoadHysteresis
from simulators.effects.spec import parse_effects
from simulators.effects.stiffening_compliance import StiffeningCompliance
from simulators.effects.transducer_scale import TransducerScale
from simulators.effects.valve_current_error import ValveCurrentError

__all__ = [
    "Backlash",
    "BoomDroop",
    "Effect",
    "EncoderHarmonic",
    "JointCompliance",
    "LoadHysteresis",
    "StiffeningCompliance",
    "TransducerScale",
    "ValveCurrentError",
    "parse_effects",
]
