"""The devices on the boom's bus: CiA 406 encoders and linear transducers, CiA 404 pressure transmitters.

Objects and defaults follow the manuals of POSITAL-type encoders (node 32, TPDO1 silent by default, node number minus
one in 3000h, save with reset by 2300h), in-cylinder transducers (6020h) and pressure transmitters (6130h, 7130h,
9130h).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from calibration.rig.channels import Cia404Analogue, Cia406Encoder, Cia406Linear
from simulators.devices.can.node import CanopenNode
from simulators.devices.can.object_dictionary import Abort, AbortError, Entry, Kind, Value

# (true value in the channel's unit, its rate per second) at an instant in simulated seconds
Source = Callable[[float], tuple[float, float]]

VENDOR = 0x42
FACTORY_NODE = 32
SAVE_WITH_RESET = 0x55AAAA55  # bytes 55 AA AA 55
SCALING_ON = 0x0004
REVERSED = 0x0001
_PRESSURE_BAR = 0x004E0000


class PositionNode(CanopenNode):
    """Base of rotary and linear CiA 406 devices.

    Args:
        node: node number.
        source: measured quantity.
        device_type, name, serial: identity.
        mapping: mapping words of both TPDOs.
    """

    def __init__(
        self, node: int, source: Source, *, device_type: int, name: str, serial: int, mapping: tuple[int, ...]
    ) -> None:
        self._source = source
        self._preset_offset = 0
        self._stored_preset_offset = 0
        identity = (VENDOR, device_type & 0xFFFF, 0x00010004, serial)
        super().__init__(node, device_type=device_type, name=name, identity=identity, mappings=(mapping, mapping))
        add = self.dictionary.add
        add(0x2300, 0, Entry(Kind.U32, access="wo", write=self._save_with_reset))
        number = self._within(0x3000, 0, 126)  # takes effect after storing and a reset
        add(0x3000, 0, Entry(Kind.U8, node - 1, access="rw", saved=True, write=number))
        add(0x3001, 0, Entry(Kind.U8, 0, access="rw", saved=True, write=self._within(0x3001, 0, 7, Abort.VALUE_HIGH)))
        add(0x6000, 0, Entry(Kind.U16, 0, access="rw", saved=True))
        add(0x6200, 0, self._timer_alias())
        add(0x2200, 0, self._timer_alias())
        add(0x6500, 0, Entry(Kind.U16, read=lambda: self.dictionary.value(0x6000)))
        add(0x6503, 0, Entry(Kind.U16, mappable=True))
        add(0x6504, 0, Entry(Kind.U16, 0xF003))
        add(0x6505, 0, Entry(Kind.U16, mappable=True))
        add(0x6506, 0, Entry(Kind.U16, 0x1000))
        add(0x6507, 0, Entry(Kind.U32, 0x04040302))  # software 4.4, profile 3.2
        add(0x6508, 0, Entry(Kind.U32, 0xFFFFFFFF))  # operating time is not supported
        add(0x6509, 0, Entry(Kind.I32, read=lambda: _wrapped_i32(self._preset_offset)))
        add(0x650B, 0, Entry(Kind.U32, serial))

    def set_alarm(self, bits: int) -> None:
        """Set the alarms (6503h); EMCY reports a new alarm, and the end of all alarms."""
        before = self.dictionary.value(0x6503)
        self.dictionary.put(0x6503, 0, bits)
        if bits & ~before:
            self.emergency(0x5000, 0x81, bits.to_bytes(2, "little"))
        elif before and not bits:
            self.emergency(0x0000, 0x00)

    def set_warning(self, bits: int) -> None:
        """Set the warnings (6505h)."""
        self.dictionary.put(0x6505, 0, bits)

    def jump(self, counts: int) -> None:
        """Shift the position by `counts`, like a preset written by someone."""
        self._preset_offset += counts

    def _timer_alias(self) -> Entry:
        tpdo = self.tpdos[0]
        return Entry(Kind.U16, access="rw", read=lambda: tpdo.timer_ms, write=tpdo.write_timer)

    def _within(self, index: int, low: int, high: int, abort: Abort = Abort.VALUE) -> Callable[[Value], None]:
        """Return a function that writes an object's value if it is within these bounds, and else aborts."""

        def write(value: Value) -> None:
            if not low <= int(value) <= high:
                raise AbortError(abort)
            self.dictionary.put(index, 0, value)

        return write

    def _save_with_reset(self, value: Value) -> None:
        if value != SAVE_WITH_RESET:
            raise AbortError(Abort.STORE)
        self.save()
        self.reset_after_answer()

    def save(self) -> None:
        super().save()
        self._stored_preset_offset = self._preset_offset

    def after_reset(self) -> None:
        self._preset_offset = self._stored_preset_offset  # a preset that was not stored is lost
        self.node = self.dictionary.value(0x3000) + 1


class EncoderNode(PositionNode):
    """A CiA 406 absolute rotary encoder.

    Args:
        node: node number.
        turns: measured shaft angle in turns, and turns per second.
        steps_per_turn: physical resolution (6501h).
        revolutions: number of distinguishable turns (6502h).
        units_per_revolution, total_units: 6001h and 6002h.
        serial: serial number.
    """

    def __init__(
        self,
        node: int = FACTORY_NODE,
        turns: Source = lambda _: (0.0, 0.0),
        *,
        steps_per_turn: int = 65536,
        revolutions: int = 1,
        units_per_revolution: int = 65536,
        total_units: int = 65536,
        serial: int = 0,
    ) -> None:
        self._steps, self._revolutions = steps_per_turn, revolutions
        device_type = 0x00010196 if revolutions == 1 else 0x00020196
        super().__init__(node, turns, device_type=device_type, name="SIM-CIA406", serial=serial, mapping=(0x60040020,))
        add = self.dictionary.add
        add(0x6000, 0, Entry(Kind.U16, SCALING_ON, access="rw", saved=True))
        for index, value, most in (
            (0x6001, units_per_revolution, steps_per_turn),
            (0x6002, total_units, steps_per_turn * revolutions),
        ):
            add(index, 0, Entry(Kind.U32, value, access="rw", saved=True, write=self._within(index, 1, most)))
        add(0x6003, 0, Entry(Kind.U32, access="rw", saved=True, write=self._write_preset))
        add(0x6004, 0, Entry(Kind.U32, read=self._position, mappable=True))
        self.dictionary.record(0x6030, Entry(Kind.I16, read=self._speed, mappable=True))
        add(0x6501, 0, Entry(Kind.U32, steps_per_turn))
        add(0x6502, 0, Entry(Kind.U16, revolutions))
        limits = (Entry(Kind.I32), Entry(Kind.I32), Entry(Kind.I32, read=lambda: _wrapped_i32(self._range() - 1)))
        self.dictionary.record(0x650A, *limits)

    def _scaled(self) -> bool:
        return bool(self.dictionary.value(0x6000) & SCALING_ON)

    def _units(self) -> int:
        return self.dictionary.value(0x6001) if self._scaled() else self._steps

    def _range(self) -> int:
        return self.dictionary.value(0x6002) if self._scaled() else self._steps * self._revolutions

    def _position(self) -> int:
        turns, _ = self._source(self._now)
        steps = round(turns * self._steps)
        if self.dictionary.value(0x6000) & REVERSED:
            steps = -steps
        return (steps * self._units() // self._steps + self._preset_offset) % self._range()

    def _speed(self) -> int:
        _, rate = self._source(self._now)
        sign = -1 if self.dictionary.value(0x6000) & REVERSED else 1
        return _clipped_i16(sign * rate * self._units())

    def _write_preset(self, value: Value) -> None:
        if int(value) >= self._range():
            raise AbortError(Abort.VALUE_HIGH)
        self.dictionary.put(0x6003, 0, value)
        self._preset_offset += int(value) - self._position()


class LinearNode(PositionNode):
    """A CiA 406 linear transducer in a cylinder: position in 6020h.1 and 6004h, signed.

    Args:
        node: node number.
        length: measured length in mm, and mm/s.
        step_nm: measuring step.
        offset_counts: position at length zero.
        sign: -1 if the counts fall as the length grows.
        mapped: object in both TPDOs, `6020` or `6004`.
        serial: serial number.
    """

    def __init__(
        self,
        node: int,
        length: Source,
        *,
        step_nm: int = 100_000,
        offset_counts: int = 0,
        sign: int = 1,
        mapped: str = "6020",
        serial: int = 0,
    ) -> None:
        self._step_nm, self._offset, self._sign = step_nm, offset_counts, sign
        word = 0x60200120 if mapped == "6020" else 0x60040020
        super().__init__(node, length, device_type=0x00080196, name="SIM-CIA406-LINEAR", serial=serial, mapping=(word,))
        add = self.dictionary.add
        add(0x6003, 0, Entry(Kind.I32, access="rw", saved=True, write=self._write_preset))
        add(0x6004, 0, Entry(Kind.I32, read=self._position, mappable=True))
        self.dictionary.record(0x6005, Entry(Kind.U32, step_nm), Entry(Kind.U32, 1))
        self.dictionary.record(0x6020, Entry(Kind.I32, read=self._position, mappable=True))
        self.dictionary.record(0x6030, Entry(Kind.I16, read=self._speed, mappable=True))
        add(0x6501, 0, Entry(Kind.U32, step_nm))
        add(0x6502, 0, Entry(Kind.U16, 1))

    def _position(self) -> int:
        length_mm, _ = self._source(self._now)
        return _wrapped_i32(round(self._sign * length_mm * 1e6 / self._step_nm) + self._offset + self._preset_offset)

    def _speed(self) -> int:
        _, rate = self._source(self._now)
        return _clipped_i16(self._sign * rate / 0.01)  # 6005h.2 = 1: steps of 0.01 mm/s

    def _write_preset(self, value: Value) -> None:
        self.dictionary.put(0x6003, 0, value)
        self._preset_offset += int(value) - self._position()


class PressureNode(CanopenNode):
    """A CiA 404 pressure transmitter, in bar.

    Args:
        node: node number.
        pressure: measured pressure in bar (and a rate that is not used).
        mapped: object in both TPDOs: `6130` (REAL32), `7130` (I16) or `9130` (I32).
        decimal_digits: 6132h.1, for the integer objects.
        serial: serial number.
    """

    def __init__(
        self, node: int, pressure: Source, *, mapped: str = "7130", decimal_digits: int = 1, serial: int = 0
    ) -> None:
        self._pressure, self._digits = pressure, decimal_digits
        word = {"6130": 0x61300120, "7130": 0x71300110, "9130": 0x91300120}[mapped]
        identity = (VENDOR, 0x0194, 0x00010001, serial)
        super().__init__(
            node, device_type=0x00020194, name="SIM-CIA404", identity=identity, mappings=((word,), (word,))
        )
        record = self.dictionary.record
        record(0x6110, Entry(Kind.U16, 90))
        record(0x6130, Entry(Kind.REAL32, read=self._bar, mappable=True))
        record(0x6131, Entry(Kind.U32, _PRESSURE_BAR))
        record(0x6132, Entry(Kind.U8, decimal_digits))
        record(0x6150, Entry(Kind.U8, mappable=True))
        record(0x7130, Entry(Kind.I16, read=lambda: _clipped_i16(self._counts()), mappable=True))
        record(0x9130, Entry(Kind.I32, read=self._counts, mappable=True))

    def _bar(self) -> float:
        return self._pressure(self._now)[0]

    def _counts(self) -> int:
        return round(self._bar() * 10.0**self._digits)


def encoder_of(channel: Cia406Encoder, degrees: Source, serial: int) -> EncoderNode:
    """Build the encoder for a rig's channel, mounted so that the channel's value is `degrees`."""
    units, total = channel.units_per_revolution, channel.total_units
    steps = max(units, 65536)

    def turns(now_s: float) -> tuple[float, float]:
        value, rate = degrees(now_s)
        return channel.sign * value / 360 + channel.zero_counts / units, channel.sign * rate / 360

    return EncoderNode(
        channel.node,
        turns,
        steps_per_turn=steps,
        revolutions=max(1, math.ceil(total / units)),
        units_per_revolution=units,
        total_units=total,
        serial=serial,
    )


def linear_of(channel: Cia406Linear, length: Source, serial: int) -> LinearNode:
    """Build the transducer for a rig's channel."""
    return LinearNode(
        channel.node,
        length,
        step_nm=channel.step_nm,
        offset_counts=channel.zero_counts,
        sign=channel.sign,
        mapped=channel.object,
        serial=serial,
    )


def pressure_of(channel: Cia404Analogue, value: Source, serial: int) -> PressureNode:
    """Build the transmitter for a rig's channel; it sends the value before the channel's scale and offset."""

    def own_unit(now_s: float) -> tuple[float, float]:
        shown, rate = value(now_s)
        return (shown - channel.offset) / channel.scale, rate / channel.scale

    return PressureNode(
        channel.node, own_unit, mapped=channel.object, decimal_digits=channel.decimal_digits, serial=serial
    )


def _wrapped_i32(value: int) -> int:
    return (value + 0x80000000) % 0x100000000 - 0x80000000


def _clipped_i16(value: float) -> int:
    return max(-32768, min(32767, round(value)))
