from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.cia404 import AnalogueChannel, AnalogueDecoder
from drivers.canopen.pdo import TransmitPdo
from drivers.errors import DescriptionError
from drivers.readings import DecodeFailure, EventKind, Reading, Status
from tests.drivers.can_support import START, at, events, the_reading

REAL32, I16, I32 = 0x61300120, 0x71300110, 0x91300120
STATUS = 0x61500108


def analogue(*words: int, **settings: object) -> AnalogueDecoder:
    pdo = TransmitPdo.usual(60, 2, words)
    settings.setdefault("process_value", words[0] >> 16)
    return AnalogueDecoder(AnalogueChannel(name="boom_pressure", unit="bar", node=60, pdo=pdo, **settings))


def test_digits_of_the_protocol_facts() -> None:
    reading = the_reading(analogue(I16, decimal_digits=2).decode(START, struct.pack("<h", 1234)))
    assert (reading.value, reading.unit, reading.raw_counts) == (12.34, "bar", 1234)
    assert the_reading(analogue(I32, decimal_digits=3).decode(START, struct.pack("<i", -1234))).value == -1.234


def test_digits_do_not_apply_to_real32() -> None:
    reading = the_reading(analogue(REAL32, decimal_digits=2).decode(START, struct.pack("<f", 12.5)))
    assert (reading.value, reading.raw_counts) == (12.5, None)


def test_default_pressure_at_bytes_4_and_5() -> None:
    decoder = analogue(REAL32, I16, process_value=0x7130, decimal_digits=1)
    assert the_reading(decoder.decode(START, bytes(4) + struct.pack("<h", 2354))).value == 235.4


def test_scale_and_offset_take_the_value_to_the_channel_s_unit() -> None:
    decoder = analogue(I16, scale=0.0689475729, offset=1.0)
    assert the_reading(decoder.decode(START, struct.pack("<h", 100))).value == pytest.approx(7.89475729)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_real32_that_is_no_number_is_not_available(value: float) -> None:
    reading = the_reading(analogue(REAL32).decode(START, struct.pack("<f", value)))
    assert (reading.value, reading.status) == (None, Status.NOT_AVAILABLE)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (0, Status.OK),
        (1, Status.NOT_AVAILABLE),
        (3, Status.OUT_OF_RANGE),
        (5, Status.OUT_OF_RANGE),
        (8, Status.NOT_AVAILABLE),
    ],
)
def test_the_input_s_own_status_is_obeyed(status: int, expected: Status) -> None:
    reading = the_reading(analogue(I16, STATUS).decode(START, struct.pack("<hB", 7, status)))
    assert reading.status is expected
    assert (reading.value is None) == (expected is not Status.OK)


def test_an_emergency_of_the_node_voids_the_value() -> None:
    decoder = analogue(I16)
    decoder.is_void = True
    assert the_reading(decoder.decode(START, bytes(2))).status is Status.DEVICE_ALARM
    assert decoder.object_read(START, 0x6503, 1) == []


def test_a_frame_that_is_too_short_is_a_failure() -> None:
    failure, reading = analogue(I16, STATUS).decode(START, bytes(2))
    assert isinstance(failure, DecodeFailure)
    assert isinstance(reading, Reading)
    assert reading.status is Status.MALFORMED


@pytest.mark.parametrize("words", [(REAL32,), (0x71300120,)])
def test_a_pdo_without_the_process_value_is_refused(words: tuple[int, ...]) -> None:
    with pytest.raises(DescriptionError, match="TPDO1 of node 60 does not contain 16 bits of object 7130h"):
        analogue(*words, process_value=0x7130)


def test_a_value_that_overflows_is_out_of_range() -> None:
    decoder = analogue(REAL32, scale=1e300)
    assert the_reading(decoder.decode(START, struct.pack("<f", 1e38))).status is Status.OUT_OF_RANGE


@given(st.binary(max_size=8), st.sampled_from([REAL32, I16, I32]))
def test_no_bytes_make_the_decoder_raise_or_give_a_number_that_is_none(data: bytes, word: int) -> None:
    reading = the_reading(analogue(word, STATUS).decode(START, data))
    assert (reading.status is Status.OK) == (reading.value is not None)
    assert reading.value is None or math.isfinite(reading.value)


def test_a_length_that_jumps_after_frames_that_were_too_short_is_told() -> None:
    decoder = analogue(I16, max_rate_per_s=20.0)
    decoder.decode(START, struct.pack("<h", 1000))
    for step in range(1, 100):
        decoder.decode(at(0.1 * step), b"\0")  # which shows that the bus was read
    decoder.decode(at(10.0), struct.pack("<h", 1000))
    records = decoder.decode(at(10.1), struct.pack("<h", 0))
    assert [event.kind for event in events(records)] == [EventKind.PRESET_JUMP]


def test_a_length_that_jumps_behind_an_emergency_is_told() -> None:
    decoder = analogue(I16, max_rate_per_s=500.0)
    decoder.decode(START, struct.pack("<h", 1000))
    decoder.is_void = True
    decoder.decode(at(0.02), struct.pack("<h", 0))
    decoder.is_void = False
    records = decoder.decode(at(0.04), struct.pack("<h", 0))
    assert [event.kind for event in events(records)] == [EventKind.PRESET_JUMP]
    assert the_reading(records).value is None
