"""Channels, the sources of readings and signals on a rig's buses, and signals that only files contain.

This module only describes channels; drivers read them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Unit = Literal["deg", "mm", "deg/s", "mm/s", "bar", "mA", "degC", "Nm", "kg", "V", "%", ""]


_PLACE = frozenset(
    (
        "link",
        "device",
        "node",
        "pdo",
        "object",
        "arbitration_id",
        "is_extended",
        "start_bit",
        "dbc",
        "message",
        "signal",
    )
)


class _Quantity(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    unit: Unit

    @property
    def column(self) -> str:
        """Name of its column in an observations CSV: `theta1_deg`, `boom_valve_mA`."""
        return f"{self.name}_{self.unit.replace('/', '_per_')}" if self.unit else self.name


class Signal(_Quantity):
    """A column of observations files in addition to joints and channels: a tilt, a temperature, a pressure.

    It is not read from a device on the machine's buses, so the observations that the daemon stores do not have it.

    Attributes:
        name: name in the column `<name>_<unit>` (`deg/s` is written `deg_per_s`), or in `<name>` without a unit.
        unit: unit of the numbers; "" for no unit or for a unit that is not listed.
    """


class AnyChannel(_Quantity):
    """Source of a joint's reading, or of a signal, on the machine's buses; `device` selects how it is read.

    Attributes:
        name: name of the joint that the channel reads, or of a signal (`boom_valve`).
        link: name of the CAN link in the daemon's configuration.
        unit: unit of the channel's value.
        timeout_s: silence for longer than this is a gap, and the last value of a signal is no longer used.
    """

    link: str = "boom"
    timeout_s: float = Field(default=1.0, gt=0)

    def place(self) -> dict[str, object]:
        """Return the attributes that determine where on the buses the value is found, by name."""
        return self.model_dump(include=set(_PLACE))

    def source(self) -> dict[str, object]:
        """Return the attributes that determine the source and meaning of the value, by name: all except times."""
        return self.model_dump(exclude={"timeout_s", "mode", "period_ms", "heartbeat_ms"})


class CanopenChannel(AnyChannel):
    """A CANopen slave.

    Attributes:
        node: CANopen node number.
        pdo: number of the TPDO that carries the value, 1 to 4.
        eds: EDS file that defines the PDO mapping; the device's usual mapping if absent.
        mode: `sync` (sampled at every SYNC) or `event_timer` (sent every `period_ms`); used by active set-up.
        period_ms: period of the event timer.
        heartbeat_ms: heartbeat producer time; 0 switches supervision off.
    """

    node: int = Field(ge=1, le=127)
    pdo: int = Field(default=1, ge=1, le=4)
    eds: str | None = None
    mode: Literal["sync", "event_timer"] = "event_timer"
    period_ms: int = Field(default=20, ge=1, le=65535)
    heartbeat_ms: int = Field(default=1000, ge=0, le=65535)


class Cia406Encoder(CanopenChannel):
    """A CiA 406 rotary encoder: value_deg = sign * (counts - zero_counts) * 360 / units_per_revolution, wrapped.

    Attributes:
        units_per_revolution: object 6001h (physical resolution 6501h when scaling is off).
        total_units: object 6002h, where the position wraps.
        sign: +1 if the joint's positive direction is the counting direction, else -1.
        zero_counts: position at which the joint reads zero.
    """

    device: Literal["cia406_encoder"]
    unit: Literal["deg"] = "deg"
    units_per_revolution: int = Field(default=65536, ge=1)
    total_units: int = Field(default=65536, ge=1)
    sign: Literal[-1, 1] = 1
    zero_counts: int = 0

    @model_validator(mode="after")
    def _range_holds_a_turn(self) -> Cia406Encoder:
        if self.total_units > 2**32:
            raise ValueError("total_units must be at most 2**32 (object 6002h is a U32)")
        return self


class Cia406Linear(CanopenChannel):
    """A CiA 406 linear transducer: value_mm = sign * (counts - zero_counts) * step_nm / 1e6.

    Attributes:
        object: `6004` or `6020` (multi-sensor devices, sub-index 1).
        step_nm: measuring step, object 6005h.1 or 6501h.
        sign, zero_counts: as for encoders.
        range_mm: measuring range; a value outside is rejected.
    """

    device: Literal["cia406_linear"]
    unit: Literal["mm"] = "mm"
    object: Literal["6004", "6020"] = "6020"
    step_nm: int = Field(default=100_000, ge=1)
    sign: Literal[-1, 1] = 1
    zero_counts: int = 0
    range_mm: tuple[float, float] = (-1e5, 1e5)


class Cia404Analogue(CanopenChannel):
    """A CiA 404 analogue input (pressure, length, temperature).

    Attributes:
        object: `6130` (REAL32), `7130` (I16) or `9130` (I32), sub-index 1.
        decimal_digits: object 6132h.1, applied to the integer forms.
        scale, offset: conversion from the device's unit to the channel's: value = reading * scale + offset.
    """

    device: Literal["cia404"]
    object: Literal["6130", "7130", "9130"] = "7130"
    decimal_digits: int = Field(default=0, ge=0, le=9)
    scale: float = 1.0
    offset: float = 0.0


class DbcSignal(AnyChannel):
    """A signal of a DBC file.

    Attributes:
        dbc: the DBC file, relative to the rig file or to the shipped rigs.
        message, signal: name in the DBC.
        scale, offset: conversion from the DBC's physical value: value = physical value * scale + offset.
    """

    device: Literal["dbc"]
    dbc: str
    message: str
    signal: str
    scale: float = 1.0
    offset: float = 0.0


class RawSignal(AnyChannel):
    """A value at a fixed place in a CAN frame, for machines without a DBC.

    Attributes:
        arbitration_id, is_extended: identifier of the frame.
        start_bit, length_bits: bits of the value, numbered as in a DBC for `byte_order` (the start bit is the least
            significant bit for Intel, the most significant bit for Motorola).
        byte_order: `intel` (little endian) or `motorola`.
        is_signed: two's complement.
        scale, offset: value = integer * scale + offset.
        not_available: integers that mean "no value" (J1939: FFh, FEh, ...).
    """

    device: Literal["raw"]
    arbitration_id: int = Field(ge=0, le=0x1FFFFFFF)
    is_extended: bool = False
    start_bit: int = Field(ge=0, le=63)
    length_bits: int = Field(ge=1, le=64)
    byte_order: Literal["intel", "motorola"] = "intel"
    is_signed: bool = False
    scale: float = 1.0
    offset: float = 0.0
    not_available: tuple[int, ...] = ()


Channel = Annotated[
    Cia406Encoder | Cia406Linear | Cia404Analogue | DbcSignal | RawSignal, Field(discriminator="device")
]
