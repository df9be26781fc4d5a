"""Decoders of CiA 406 encoders and linear transducers: position, alarms and warnings of a TPDO."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from drivers.canopen.pdo_channel import PdoChannel, PdoChannelDecoder
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.jumps import JumpWatch, jump_event
from drivers.readings import DecodeFailure, DeviceEvent, EventKind, Reading, Record, Status

POSITION = 0x6004
POSITION_MULTI_SENSOR = 0x6020
ALARMS = 0x6503
WARNINGS = 0x6505

_ALARM_BITS = {0: "position error", 1: "commissioning diagnostics"}
_WARNING_BITS = {
    0: "frequency or speed exceeded",
    1: "light control reserve",
    2: "CPU watchdog",
    3: "operating time limit",
    4: "battery charge low",
    5: "reference point not reached",
}


_FLAGS = {
    ALARMS: (EventKind.ALARM, "alarms (6503h)", _ALARM_BITS),
    WARNINGS: (EventKind.WARNING, "warnings (6505h)", _WARNING_BITS),
}


def _flag_texts(flags: int, texts: dict[int, str]) -> str:
    """Return descriptions of the bits set in object 6503h or 6505h."""
    return ", ".join(
        texts.get(bit, f"manufacturer bit {bit}" if bit >= 12 else f"reserved bit {bit}")
        for bit in range(16)
        if flags >> bit & 1
    )


@dataclass(frozen=True, kw_only=True)
class PositionChannel(PdoChannel):
    """Settings that encoders and linear transducers share.

    Attributes:
        sign: +1 if the counts rise in the joint's positive direction, -1 if they fall.
        zero_counts: position in counts at which the joint's value is zero.
        max_rate_per_s: fastest motion of the joint in units per second; None to skip the check for jumps.
    """

    sign: Literal[-1, 1] = 1
    zero_counts: int = 0
    max_rate_per_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class EncoderChannel(PositionChannel):
    """A rotary encoder: value_deg = sign * (counts - zero_counts) * 360 / units_per_revolution.

    The position wraps at `total_units`, and the value is wrapped to the interval of that width centred on zero. If
    `total_units` is a power of two, the bits above it are status bits (POSITAL limit switches) and are masked.

    Attributes:
        units_per_revolution: object 6001h, or 6501h when scaling is off.
        total_units: object 6002h.
    """

    unit: str = "deg"
    units_per_revolution: int = 65536
    total_units: int = 65536


@dataclass(frozen=True, kw_only=True)
class LinearChannel(PositionChannel):
    """A linear transducer: value_mm = sign * (counts - zero_counts) * step_nm / 1e6.

    Attributes:
        position_object: POSITION (6004h) or POSITION_MULTI_SENSOR (6020h).
        step_nm: measuring step, object 6005h.1 or 6501h.
        range_mm: measuring range; a value outside it is OUT_OF_RANGE.
    """

    unit: str = "mm"
    position_object: int = POSITION_MULTI_SENSOR
    step_nm: int = 100_000
    range_mm: tuple[float, float] = (-1e5, 1e5)


_JUMP_SLACK_COUNTS = 2.0


class _PositionDecoder(PdoChannelDecoder):
    """Base of both decoders: alarms, warnings and jumps."""

    def __init__(
        self, channel: PositionChannel, position_object: int, counts_per_unit: float, modulus: int | None = None
    ) -> None:
        super().__init__(channel)
        mapping = channel.pdo.mapping
        position = mapping.find(position_object)
        if position is None:
            raise DescriptionError(channel.name, channel.does_not_carry(f"object {position_object:04X}h"))
        self._position = position
        self._flag_fields = [field for index in _FLAGS if (field := mapping.find(index)) is not None]
        self._needed_bits = max(field.end_bit for field in (position, *self._flag_fields))
        self._flags = dict.fromkeys(_FLAGS, 0)
        rate = channel.max_rate_per_s
        self._jumps = None if rate is None else JumpWatch(rate * counts_per_unit, _JUMP_SLACK_COUNTS, modulus)

    def object_read(self, stamp: Stamp, index: int, value: int) -> list[Record]:
        records: list[Record] = []
        if index in _FLAGS:
            self._take_flags(stamp, index, value, self._answered(_FLAGS[index][1]), records)
        return records

    def _answered(self, name: str) -> str:
        """Return how events name flags that were read over SDO. `recall` relies on this text."""
        return f"node {self.node}: {name} read over SDO"

    def recall(self, event: DeviceEvent) -> bool:
        carried = {field.index for field in self._flag_fields}  # the next PDO reports these
        for index, (kind, name, _) in _FLAGS.items():
            is_answer = event.text.startswith(self._answered(name)) and event.code is not None
            if event.kind is kind and is_answer and index not in carried:
                self._flags[index] = event.code or 0
                return True
        return False

    def node_restarted(self) -> None:
        self._flags = dict.fromkeys(_FLAGS, 0)

    def _take_flags(self, stamp: Stamp, index: int, flags: int, name: str, records: list[Record]) -> None:
        """Add an event to `records` if the alarms or warnings have changed."""
        if flags != self._flags[index]:
            self._flags[index] = flags
            kind, _, texts = _FLAGS[index]
            text = f"{name}: {_flag_texts(flags, texts)}" if flags else f"{name} have cleared"
            records.append(DeviceEvent(self.name, stamp, kind, text, flags))

    def decode(self, stamp: Stamp, data: bytes) -> list[Record]:
        """Return the records of one frame.

        A jump that no motion explains is reported as an event, and its reading has no value, because the zero that the
        position counts from is unknown. Later samples are returned as the device sends them; the event asks the
        operator to check the joint's zero.
        """
        if len(data) * 8 < self._needed_bits:
            return self._too_short(stamp, data, self._needed_bits)
        records: list[Record] = []
        bits = int.from_bytes(data, "little")
        for field in self._flag_fields:
            self._take_flags(stamp, field.index, field.extract(bits), _FLAGS[field.index][1], records)
        counts, status = self._counts(bits)
        if self._flags[ALARMS] or self.is_void:
            status = Status.DEVICE_ALARM
        if status is not Status.OK:
            if status is Status.MALFORMED:
                unsigned = self._position.extract(bits)
                reason = f"{unsigned} and {counts} counts are both within range_mm: narrow it to the transducer's range"
                records.append(DecodeFailure(self.name, stamp, reason, data))
            if self._jumps is not None:
                self._jumps.bad(stamp)
            records.append(Reading(self.name, stamp, None, self._unit, status, counts))
            return records
        reading = Reading(self.name, stamp, self._value(counts), self._unit, Status.OK, counts)
        before = None if self._jumps is None else self._jumps.jumped_from(stamp, counts)
        if before is not None:
            records.append(jump_event(reading, self._value(int(before))))
            reading = replace(reading, value=None, status=Status.OUT_OF_RANGE)
        records.append(reading)
        return records

    def _counts(self, bits: int) -> tuple[int, Status]:
        """Return the position in a PDO, and its status apart from alarms."""
        raise NotImplementedError

    def _value(self, counts: int) -> float:
        """Convert a position to the joint's value."""
        raise NotImplementedError


class EncoderDecoder(_PositionDecoder):
    """Decoder of one `EncoderChannel`.

    Raises:
        DescriptionError: the PDO does not contain 6004h, or the counts per revolution or in total are out of range.
    """

    def __init__(self, channel: EncoderChannel) -> None:
        if channel.units_per_revolution < 1 or not 1 <= channel.total_units <= 1 << 32:
            raise DescriptionError(
                channel.name, "units_per_revolution must be at least 1 and total_units 1 to 2**32 (a U32)"
            )
        super().__init__(channel, POSITION, channel.units_per_revolution / 360.0, channel.total_units)
        total = channel.total_units
        self._total = total
        self._shift = self._position.first_bit
        self._mask = (1 << self._position.length_bits) - 1
        if total & (total - 1) == 0:
            self._mask &= total - 1
        # For sign -1 the open end of the interval changes sides, so that half a turn is -180 deg as for sign +1
        self._half = total // 2 if channel.sign == 1 else (total - 1) // 2
        self._zero = channel.zero_counts
        self._deg_per_count = channel.sign * 360.0 / channel.units_per_revolution

    def _counts(self, bits: int) -> tuple[int, Status]:
        counts = bits >> self._shift & self._mask
        return counts, Status.OK if counts < self._total else Status.OUT_OF_RANGE

    def _value(self, counts: int) -> float:
        half = self._half
        return ((counts - self._zero + half) % self._total - half) * self._deg_per_count


class LinearDecoder(_PositionDecoder):
    """Decoder of one `LinearChannel`.

    6020h is signed. 6004h is unsigned by the profile but signed on some transducers: of the two interpretations the one
    within `range_mm` is used; if both are, the reading has no value.

    Raises:
        DescriptionError: the PDO does not contain the position object, or the step is not positive.
    """

    def __init__(self, channel: LinearChannel) -> None:
        if channel.step_nm < 1:
            raise DescriptionError(channel.name, f"step_nm must be at least 1, got {channel.step_nm}")
        self._nm_per_count = channel.sign * channel.step_nm
        super().__init__(channel, channel.position_object, 1e6 / channel.step_nm)
        self._zero = channel.zero_counts
        self._range = channel.range_mm
        self._may_be_unsigned = channel.position_object == POSITION

    def _counts(self, bits: int) -> tuple[int, Status]:
        counts = self._position.extract_signed(bits)
        if counts < 0 and self._may_be_unsigned and not (self._flags[ALARMS] or self.is_void):
            unsigned = self._position.extract(bits)
            if self._is_in_range(unsigned):
                return (counts, Status.MALFORMED) if self._is_in_range(counts) else (unsigned, Status.OK)
        return counts, Status.OK if self._is_in_range(counts) else Status.OUT_OF_RANGE

    def _value(self, counts: int) -> float:
        return (counts - self._zero) * self._nm_per_count / 1e6

    def _is_in_range(self, counts: int) -> bool:
        return self._range[0] <= self._value(counts) <= self._range[1]
