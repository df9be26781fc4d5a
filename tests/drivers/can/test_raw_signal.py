from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.raw_signal import BitField, Multiplexing, SignalChannel, SignalDecoder
from drivers.errors import DescriptionError
from drivers.readings import DecodeFailure, EventKind, Gap, GapReason, Reading, Status
from tests.drivers.can_support import START, at, events, the_reading


def signal(field: BitField, **settings: object) -> SignalDecoder:
    return SignalDecoder(SignalChannel(name="pump", unit="bar", arbitration_id=0x201, field=field, **settings))


def test_an_intel_signal_is_placed_by_its_least_significant_bit() -> None:
    assert BitField(4, 12).extract(bytes.fromhex("A5BC")) == 0xBCA
    assert BitField(0, 64).extract(bytes(range(8))) == int.from_bytes(bytes(range(8)), "little")


def test_a_motorola_signal_is_placed_by_its_most_significant_bit() -> None:
    assert BitField(7, 16, "motorola").extract(bytes.fromhex("1234")) == 0x1234
    assert BitField(3, 12, "motorola").extract(bytes.fromhex("A5BC")) == 0x5BC
    assert BitField(7, 64, "motorola").extract(bytes(range(8))) == int.from_bytes(bytes(range(8)), "big")


def test_twos_complement() -> None:
    field = BitField(0, 12, is_signed=True)
    assert [field.as_signed(counts) for counts in (0x7FF, 0x800, 0xFFF)] == [2047, -2048, -1]


@pytest.mark.parametrize(
    "field", [(60, 8, "intel"), (0, 65, "intel"), (-1, 8, "intel"), (0, 0, "intel"), (56, 2, "motorola")]
)
def test_a_field_outside_the_frame_is_refused(field: tuple[int, int, str]) -> None:
    with pytest.raises(ValueError, match="do not fit in a frame of 8 bytes"):
        BitField(*field)


def test_scale_and_offset() -> None:
    reading = the_reading(signal(BitField(0, 16), factor=0.1, scale=100.0, offset=5.0).decode(START, b"\x32\x09"))
    assert reading.value == pytest.approx(23545.0)
    assert reading.raw_counts == 2354


def test_named_integers_mean_no_value_as_the_field_is_signed() -> None:
    decoder = signal(BitField(0, 8, is_signed=True), not_available=frozenset({-1}))
    assert the_reading(decoder.decode(START, b"\xff")).status is Status.NOT_AVAILABLE
    assert the_reading(decoder.decode(START, b"\xfe")).value == -2.0


def test_all_ones_of_an_unsigned_field_mean_no_value() -> None:
    assert the_reading(signal(BitField(0, 8), all_ones_is_not_available=True).decode(START, b"\xff")).value is None
    assert the_reading(signal(BitField(0, 7), all_ones_is_not_available=True).decode(START, b"\x7f")).value == 127.0
    assert the_reading(signal(BitField(0, 8)).decode(START, b"\xff")).value == 255.0


@pytest.mark.parametrize(
    ("length", "counts", "is_value"),
    [
        (8, 0xFD, True),
        (8, 0xFE, False),
        (8, 0xFF, False),
        (16, 0xFDFF, True),
        (16, 0xFE00, False),
        (16, 0xFF42, False),
        (32, 0xFE000000, False),
        (2, 1, True),
        (2, 2, False),
        (4, 13, True),
        (4, 14, False),
        (1, 1, True),
    ],
)
def test_j1939_reserves_the_top_of_a_field(length: int, counts: int, is_value: bool) -> None:
    decoder = signal(BitField(0, length), is_j1939=True, is_extended=True)
    reading = the_reading(decoder.decode(START, counts.to_bytes(8, "little")))
    assert (reading.status is Status.OK) is is_value
    assert is_value or reading.status is Status.NOT_AVAILABLE


def test_a_signed_field_of_j1939_has_no_reserved_top() -> None:
    decoder = signal(BitField(0, 8, is_signed=True), is_j1939=True)
    assert the_reading(decoder.decode(START, b"\xff")).value == -1.0


def test_beyond_the_declared_range_there_is_no_value() -> None:
    decoder = signal(BitField(0, 8), minimum=10.0, maximum=20.0, scale=2.0)
    values = [the_reading(decoder.decode(START, bytes((counts,)))) for counts in (9, 10, 20, 21)]
    assert [reading.value for reading in values] == [None, 20.0, 40.0, None]
    assert values[0].status is Status.OUT_OF_RANGE


@pytest.mark.parametrize(("code", "length"), [("e", 16), ("f", 32), ("d", 64)])
def test_floats_of_every_length(code: str, length: int) -> None:
    decoder = signal(BitField(0, length), is_float=True)
    assert the_reading(decoder.decode(START, struct.pack("<" + code, -2.5))).value == -2.5
    assert the_reading(decoder.decode(START, struct.pack("<" + code, math.nan))).status is Status.NOT_AVAILABLE
    assert the_reading(decoder.decode(START, struct.pack("<" + code, math.inf))).value is None


def test_a_float_of_another_length_is_refused() -> None:
    with pytest.raises(DescriptionError, match="pump: a float of 24 bits"):
        signal(BitField(0, 24), is_float=True)


def test_a_multiplexed_signal_is_there_only_when_selected() -> None:
    decoder = signal(BitField(8, 8), multiplexing=Multiplexing(BitField(0, 8), frozenset({3})))
    assert the_reading(decoder.decode(START, b"\x03\x07")).value == 7.0
    assert decoder.decode(START, b"\x04\x07") == []
    assert isinstance(decoder.decode(START, b"")[0], DecodeFailure)


def test_a_frame_that_is_too_short_is_a_failure() -> None:
    failure, reading = signal(BitField(8, 8)).decode(START, b"\x01")
    assert isinstance(failure, DecodeFailure)
    assert failure.reason == "the frame has 1 bytes, the value needs 2"
    assert isinstance(reading, Reading)
    assert reading.status is Status.MALFORMED


def counted(decoder: SignalDecoder, seconds: float, count: int) -> list[Gap]:
    return [r for r in decoder.decode(at(seconds), bytes((0, count))) if isinstance(r, Gap)]


def test_frames_missing_by_the_counter_are_a_closed_gap() -> None:
    decoder = signal(BitField(0, 8), counter=BitField(8, 4))
    assert counted(decoder, 0.00, 14) == []
    assert counted(decoder, 0.01, 15) == []
    assert counted(decoder, 0.02, 0) == []
    assert counted(decoder, 0.05, 3) == [Gap("pump", GapReason.FRAMES_LOST, at(0.02), at(0.05), 2)]
    assert counted(decoder, 0.06, 3) == []


def test_the_counter_tells_nothing_after_a_silence() -> None:
    decoder = signal(BitField(0, 8), counter=BitField(8, 4), timeout_s=1.0)
    counted(decoder, 0.0, 0)
    assert counted(decoder, 1.5, 9) == []


def test_a_frame_without_room_for_its_counter_still_has_its_value() -> None:
    decoder = signal(BitField(0, 8), counter=BitField(8, 4))
    assert the_reading(decoder.decode(START, b"\x05")).value == 5.0


@given(
    st.binary(max_size=8), st.integers(0, 63), st.integers(1, 64), st.sampled_from(["intel", "motorola"]), st.booleans()
)
def test_no_bytes_make_the_decoder_raise(data: bytes, start: int, length: int, order: str, is_signed: bool) -> None:
    try:
        field = BitField(start, length, order, is_signed)
    except ValueError:
        return
    decoder = signal(field, factor=1e300, scale=1e300, is_j1939=True, counter=BitField(0, 4))
    reading = the_reading(decoder.decode(START, data))
    assert (reading.status is Status.OK) == (reading.value is not None)
    assert reading.value is None or math.isfinite(reading.value)


def test_a_joint_in_raw_frames_that_jumps_behind_missing_values_is_told() -> None:
    decoder = SignalDecoder(
        SignalChannel(
            name="theta1",
            unit="deg",
            arbitration_id=0x201,
            field=BitField(0, 16),
            factor=0.01,
            not_available=frozenset({0xFFFF}),
            max_rate_per_s=20.0,
        )
    )
    assert the_reading(decoder.decode(START, (1000).to_bytes(2, "little"))).value == 10.0
    assert the_reading(decoder.decode(at(0.02), b"\xff\xff")).status is Status.NOT_AVAILABLE
    records = decoder.decode(at(0.04), (4300).to_bytes(2, "little"))
    assert [event.kind for event in events(records)] == [EventKind.PRESET_JUMP]
    assert (the_reading(records).value, the_reading(records).status) == (None, Status.OUT_OF_RANGE)
    assert the_reading(decoder.decode(at(0.06), (4300).to_bytes(2, "little"))).value == 43.0


@pytest.mark.parametrize("is_j1939", [False, True])
def test_a_jump_after_frames_that_were_too_short_is_told(is_j1939: bool) -> None:
    channel = SignalChannel(
        name="theta1",
        unit="deg",
        arbitration_id=0x18FF0001,
        is_extended=True,
        is_j1939=is_j1939,
        field=BitField(0, 16),
        factor=0.01,
        max_rate_per_s=20.0,
    )
    decoder = SignalDecoder(channel)
    decoder.decode(START, (1000).to_bytes(2, "little"))
    for step in range(1, 100):
        decoder.decode(at(0.1 * step), b"\0")  # which shows that the bus was read
    decoder.decode(at(10.0), (1000).to_bytes(2, "little"))
    records = decoder.decode(at(10.1), (4300).to_bytes(2, "little"))
    assert [event.kind for event in events(records)] == [EventKind.PRESET_JUMP]


def test_a_joint_in_raw_frames_may_pass_the_full_turn() -> None:
    decoder = SignalDecoder(
        SignalChannel(name="theta1", unit="deg", arbitration_id=0x201, field=BitField(0, 16), max_rate_per_s=20.0)
    )
    decoder.decode(START, (359).to_bytes(2, "little"))
    assert not events(decoder.decode(at(0.02), (1).to_bytes(2, "little")))
