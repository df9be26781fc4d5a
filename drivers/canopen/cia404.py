"""Decoder of CiA 404 analogue inputs (pressure, length, temperature): the process value of a TPDO."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.can.channel import value_reading
from drivers.canopen.pdo_channel import PdoChannel, PdoChannelDecoder
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.jumps import checked_reading, joint_watch
from drivers.readings import Reading, Record, Status

PROCESS_VALUE_REAL32 = 0x6130
PROCESS_VALUE_I16 = 0x7130
PROCESS_VALUE_I32 = 0x9130
INPUT_STATUS = 0x6150

_LENGTHS = {PROCESS_VALUE_REAL32: 32, PROCESS_VALUE_I16: 16, PROCESS_VALUE_I32: 32}

UNIT_TEXTS = {0x004E0000: "bar", 0x00AB0000: "psi", 0x002D0000: "degC", 0x00AC0000: "degF"}
"""Value of object 6131h -> physical unit."""


@dataclass(frozen=True, kw_only=True)
class AnalogueChannel(PdoChannel):
    """An analogue input: value = process value * scale + offset.

    Attributes:
        process_value: PROCESS_VALUE_REAL32 (6130h), PROCESS_VALUE_I16 (7130h) or PROCESS_VALUE_I32 (9130h).
        decimal_digits: object 6132h: 1234 with 2 digits is 12.34; does not apply to REAL32.
        scale, offset: conversion from the device's unit to the channel's.
        max_rate_per_s: fastest motion of the joint in units per second; None to skip the check for jumps.
    """

    process_value: int = PROCESS_VALUE_I16
    decimal_digits: int = 0
    scale: float = 1.0
    offset: float = 0.0
    max_rate_per_s: float | None = None


class AnalogueDecoder(PdoChannelDecoder):
    """Decoder of one `AnalogueChannel`.

    A REAL32 value that is infinite or NaN is "not available". If the PDO contains the input's status (6150h), overload
    bits 1 and 2 make the value out of range, and any other set bit makes it not available.

    Raises:
        DescriptionError: the PDO does not contain the process value with the right length.
    """

    def __init__(self, channel: AnalogueChannel) -> None:
        super().__init__(channel)
        mapping = channel.pdo.mapping
        value = mapping.find(channel.process_value)
        length = _LENGTHS[channel.process_value]
        if value is None or value.length_bits != length:
            what = f"{length} bits of object {channel.process_value:04X}h"
            raise DescriptionError(channel.name, channel.does_not_carry(what))
        self._value = value
        self._status = mapping.find(INPUT_STATUS)
        self._needed_bits = max(value.end_bit, self._status.end_bit if self._status else 0)
        self._is_real = channel.process_value == PROCESS_VALUE_REAL32
        self._divisor = 10.0**channel.decimal_digits
        self._scale, self._offset = channel.scale, channel.offset
        step = 0.0 if self._is_real else channel.scale / self._divisor
        self._jumps = joint_watch(channel.max_rate_per_s, step, channel.unit)

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        if len(data) * 8 < self._needed_bits:
            return self._too_short(stamp, data, self._needed_bits)
        reading = self._reading(stamp, int.from_bytes(data, "little"))
        return [reading] if self._jumps is None else checked_reading(self._jumps, reading)

    def _reading(self, stamp: Stamp, bits: int) -> Reading:
        counts: int | None
        if self._is_real:
            counts = None
            (value,) = struct.unpack("<f", self._value.extract(bits).to_bytes(4, "little"))
        else:
            counts = self._value.extract_signed(bits)
            value = counts / self._divisor
        status = self._status.extract(bits) if self._status else 0
        if self.is_void:
            return Reading(self.name, stamp, None, self._unit, Status.DEVICE_ALARM, counts)
        if status & 0b110:
            return Reading(self.name, stamp, None, self._unit, Status.OUT_OF_RANGE, counts)
        if status or value - value != 0.0:  # infinite or not a number
            return Reading(self.name, stamp, None, self._unit, Status.NOT_AVAILABLE, counts)
        return value_reading(self.name, self._unit, stamp, value * self._scale + self._offset, counts)
