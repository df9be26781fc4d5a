"""Effects as text: `joint_compliance@theta4:compliance_rad_per_Nm=2e-8,boom_droop@boom`."""

from __future__ import annotations

import math
from dataclasses import fields

from simulators.effects.backlash import Backlash
from simulators.effects.base import Effect
from simulators.effects.boom_droop import BoomDroop
from simulators.effects.encoder_harmonic import EncoderHarmonic
from simulators.effects.joint_compliance import JointCompliance
from simulators.effects.load_hysteresis import LoadHysteresis
from simulators.effects.stiffening_compliance import StiffeningCompliance
from simulators.effects.transducer_scale import TransducerScale
from simulators.effects.valve_current_error import ValveCurrentError

FAMILIES: dict[str, type[Effect]] = {
    kind.family: kind
    for kind in (
        JointCompliance,
        StiffeningCompliance,
        BoomDroop,
        EncoderHarmonic,
        Backlash,
        LoadHysteresis,
        TransducerScale,
        ValveCurrentError,
    )
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
