"""Decoder of signals at a fixed position in a CAN frame, as described by a DBC or a rig file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

from drivers.can.channel import too_short, value_reading
from drivers.can.frame import DATA_MAX
from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DescriptionError
from drivers.jumps import checked_reading, joint_watch
from drivers.readings import Gap, GapReason, Reading, Record, Status

_FLOATS = {16: ("<e", 2), 32: ("<f", 4), 64: ("<d", 8)}


@dataclass(frozen=True, slots=True)
class BitField:
    """The position of a field in a frame.

    Attributes:
        start_bit: numbered as in a DBC: bit n is bit n % 8 of byte n // 8. It is the signal's least significant bit
            for `intel` (little endian) and its most significant bit for `motorola` (big endian).
        length_bits: 1 to 64.
        byte_order: `intel` or `motorola`.
        is_signed: two's complement.

    Raises:
        ValueError: the field does not fit in a frame of 8 bytes.
    """

    start_bit: int
    length_bits: int
    byte_order: Literal["intel", "motorola"] = "intel"
    is_signed: bool = False

    def __post_init__(self) -> None:
        if self.start_bit < 0 or self.length_bits < 1 or self.end_bit > 8 * DATA_MAX:
            raise ValueError(
                f"{self.length_bits} bits at {self.byte_order} bit {self.start_bit} do not fit in a frame of 8 bytes"
            )

    @property
    def end_bit(self) -> int:
        """Number of bits that a frame must have to hold the field."""
        return self._first_bit + self.length_bits

    @property
    def _first_bit(self) -> int:
        """Number of bits before the field, counted in its byte order."""
        if self.byte_order == "intel":
            return self.start_bit
        return self.start_bit // 8 * 8 + 7 - self.start_bit % 8

    def extract(self, data: bytes) -> int | None:
        """Return the field's content as an unsigned integer; None if the frame is too short."""
        size = len(data) * 8
        if size < self.end_bit:
            return None
        if self.byte_order == "intel":
            return int.from_bytes(data, "little") >> self.start_bit & ((1 << self.length_bits) - 1)
        return int.from_bytes(data, "big") >> size - self.end_bit & ((1 << self.length_bits) - 1)

    def as_signed(self, counts: int) -> int:
        """Convert the field's unsigned content to a signed integer if `is_signed`; else return it unchanged."""
        if not self.is_signed:
            return counts
        half = 1 << self.length_bits - 1
        return (counts ^ half) - half


@dataclass(frozen=True, slots=True)
class Multiplexing:
    """Condition of a multiplexed signal: `selector` holds one of `values`."""

    selector: BitField
    values: frozenset[int]


@dataclass(frozen=True, kw_only=True)
class SignalChannel:
    """A signal of a frame: value = (counts * factor + summand) * scale + offset.

    Attributes:
        name: name of the signal.
        unit: unit of the value.
        arbitration_id, is_extended: identifier of the frame.
        field: position of the signal in the frame.
        is_float: the field is an IEEE 754 number of 16, 32 or 64 bits.
        factor, summand: conversion from counts to the physical value of the message's description.
        scale, offset: conversion from the physical value to the channel's unit.
        minimum, maximum: declared range of the physical value; None if none is declared.
        not_available: integers that mean "no value", signed if the field is.
        all_ones_is_not_available: in unsigned fields of 8 bits and more, all bits set means "no value".
        is_j1939: unsigned fields follow J1939-71: a most significant byte of FFh means "not available", FEh "error"; in
            fields of 2 to 7 bits the largest value and the one below mean the same.
        counter: a message counter in the same frame that rises by one with every frame.
        multiplexing: condition under which the frame contains the signal; None if it always does.
        timeout_s: silence longer than this is a gap.
        max_rate_per_s: fastest motion of the joint in units per second; None to skip the check for jumps.
    """

    name: str
    unit: str
    arbitration_id: int
    field: BitField
    is_extended: bool = False
    is_float: bool = False
    factor: float = 1.0
    summand: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    not_available: frozenset[int] = frozenset()
    all_ones_is_not_available: bool = False
    is_j1939: bool = False
    counter: BitField | None = None
    multiplexing: Multiplexing | None = None
    timeout_s: float = 1.0
    max_rate_per_s: float | None = None


class SignalDecoder:
    """Decoder of one `SignalChannel`.

    Frames that are missing according to the message counter are recorded as a closed gap. No loss is derived from a
    counter that does not change (the frame was repeated, or its sender does not count) or from the first count after a
    silence that was itself a gap.

    Attributes:
        missed_frames: number of missing frames so far; None until the message counter has been seen to count.

    Raises:
        DescriptionError: the length of a float field is not one of IEEE 754.
    """

    def __init__(self, channel: SignalChannel) -> None:
        if channel.is_float and channel.field.length_bits not in _FLOATS:
            raise DescriptionError(channel.name, f"a float of {channel.field.length_bits} bits is not supported")
        self.name = channel.name
        self.arbitration_id = channel.arbitration_id
        self.is_extended = channel.is_extended
        self.timeout_s = channel.timeout_s
        self.missed_frames: int | None = None
        self._channel = channel
        self._unit = channel.unit
        self._field = channel.field
        field = channel.field
        self._not_available = channel.not_available
        if channel.all_ones_is_not_available and not field.is_signed and field.length_bits >= 8:
            self._not_available |= {(1 << field.length_bits) - 1}
        self._reserved = _j1939_reserved(field) if channel.is_j1939 and not field.is_signed else None
        self._last: tuple[Stamp, int] | None = None
        step = 0.0 if channel.is_float else channel.factor * channel.scale
        self._jumps = joint_watch(channel.max_rate_per_s, step, channel.unit)

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        records: list[Record] = []
        if self._channel.counter is not None:
            self._count(self._channel.counter, stamp, data, records)
        multiplexing = self._channel.multiplexing
        if multiplexing is not None:
            selected = multiplexing.selector.extract(data)
            if selected is None:
                return records + self._too_short(stamp, data, multiplexing.selector.end_bit)
            if selected not in multiplexing.values:
                return records
        unsigned = self._field.extract(data)
        if unsigned is None:
            return records + self._too_short(stamp, data, self._field.end_bit)
        reading = self._reading(stamp, unsigned)
        return records + (checked_reading(self._jumps, reading) if self._jumps is not None else [reading])

    def _too_short(self, stamp: Stamp, data: bytes, needed_bits: int) -> list[Record]:
        return too_short(self.name, self._unit, stamp, data, needed_bits, self._jumps)

    def _reading(self, stamp: Stamp, unsigned: int) -> Reading:
        channel = self._channel
        if channel.is_float:
            code, size = _FLOATS[self._field.length_bits]
            (number,) = struct.unpack(code, unsigned.to_bytes(size, "little"))
            if number - number != 0.0:  # infinite or not a number
                return Reading(self.name, stamp, None, self._unit, Status.NOT_AVAILABLE)
            physical, counts = number * channel.factor + channel.summand, None
        else:
            counts = self._field.as_signed(unsigned)
            reserved = self._reserved
            if counts in self._not_available or (reserved is not None and unsigned >> reserved[0] >= reserved[1]):
                return Reading(self.name, stamp, None, self._unit, Status.NOT_AVAILABLE, counts)
            physical = counts * channel.factor + channel.summand
        if (channel.minimum is not None and physical < channel.minimum) or (
            channel.maximum is not None and physical > channel.maximum
        ):
            return Reading(self.name, stamp, None, self._unit, Status.OUT_OF_RANGE, counts)
        return value_reading(self.name, self._unit, stamp, physical * channel.scale + channel.offset, counts)

    def _count(self, counter: BitField, stamp: Stamp, data: bytes, records: list[Record]) -> None:
        count = counter.extract(data)
        if count is None:
            return
        last, self._last = self._last, (stamp, count)
        if last is None or count == last[1] or stamp.since(last[0]) > self.timeout_s * NS_PER_S:
            return
        missed = (count - last[1] - 1) % (1 << counter.length_bits)
        self.missed_frames = (self.missed_frames or 0) + missed
        if missed:
            records.append(Gap(self.name, GapReason.FRAMES_LOST, last[0], stamp, missed))


def _j1939_reserved(field: BitField) -> tuple[int, int]:
    """Return the range that J1939-71 reserves at the top of a field ("error", and above it "not available").

    Returns:
        (shift, lowest): an integer is reserved if `counts >> shift >= lowest`.
    """
    significant = min(field.length_bits, 8)
    lowest = (1 << significant) - 2 if field.length_bits >= 2 else 2  # a single bit has no reserved value
    return field.length_bits - significant, lowest
