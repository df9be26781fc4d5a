from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.cia406 import (
    EncoderChannel,
    EncoderDecoder,
    LinearChannel,
    LinearDecoder,
)
from drivers.canopen.pdo import TransmitPdo
from drivers.errors import DescriptionError
from drivers.readings import DecodeFailure, EventKind, Reading, Record, Status
from tests.drivers.can_support import START, at, events, the_reading

POSITION = 0x60040020
SPEED = 0x60300110
ALARMS = 0x65030010
WARNINGS = 0x65050010


def encoder(*words: int, **settings: object) -> EncoderDecoder:
    pdo = TransmitPdo.usual(32, 1, words or (POSITION,))
    return EncoderDecoder(EncoderChannel(name="theta1", node=32, pdo=pdo, **settings))


def linear(*words: int, **settings: object) -> LinearDecoder:
    pdo = TransmitPdo.usual(48, 1, words or (0x60200120,))
    return LinearDecoder(LinearChannel(name="L2", node=48, pdo=pdo, **settings))


def u32(value: int) -> bytes:
    return (value & 0xFFFFFFFF).to_bytes(4, "little")


def test_position_of_the_protocol_facts() -> None:
    decoder = encoder(units_per_revolution=8192, total_units=1 << 25)
    reading = the_reading(decoder.decode(START, bytes.fromhex("4E61BC00")))
    assert reading.raw_counts == 12345678
    assert reading.value == pytest.approx(12345678 * 360 / 8192)
    assert (reading.channel, reading.unit, reading.status) == ("theta1", "deg", Status.OK)


def test_sign_and_zero_of_a_single_turn_encoder() -> None:
    assert the_reading(encoder(zero_counts=20000).decode(START, u32(20000))).value == 0.0
    assert the_reading(encoder(zero_counts=20000).decode(START, u32(20000 + 16384))).value == 90.0
    assert the_reading(encoder(zero_counts=20000, sign=-1).decode(START, u32(20000 + 16384))).value == -90.0


@pytest.mark.parametrize(
    ("counts", "sign", "value"),
    [(32767, 1, 179.9945068359375), (32768, 1, -180.0), (65535, 1, -0.0054931640625), (32768, -1, -180.0)],
)
def test_the_value_wraps_to_the_interval_centred_on_zero(counts: int, sign: int, value: float) -> None:
    assert the_reading(encoder(sign=sign).decode(START, u32(counts))).value == pytest.approx(value)


@given(st.integers(1, 1 << 32), st.integers(1, 1 << 20), st.integers(0, 1 << 32), st.sampled_from([-1, 1]), st.data())
def test_every_position_has_one_value_within_half_the_range(
    total: int, units: int, zero: int, sign: int, data: st.DataObject
) -> None:
    counts = data.draw(st.integers(0, total - 1))
    decoder = encoder(units_per_revolution=units, total_units=total, zero_counts=zero, sign=sign)
    value = the_reading(decoder.decode(START, u32(counts))).value
    assert value is not None
    assert abs(value) <= total * 180 / units
    assert round(value * sign * units / 360 - (counts - zero)) % total == 0


def test_status_bits_above_a_power_of_two_are_masked() -> None:
    decoder = encoder(units_per_revolution=8192, total_units=1 << 25)
    reading = the_reading(decoder.decode(START, u32(0x80000000 | 4096)))
    assert (reading.value, reading.raw_counts) == (180.0, 4096)


def test_a_position_beyond_a_range_that_is_no_power_of_two_has_no_value() -> None:
    decoder = encoder(units_per_revolution=36000, total_units=36000)
    assert the_reading(decoder.decode(START, u32(9000))).value == 90.0
    reading = the_reading(decoder.decode(START, u32(36000)))
    assert (reading.value, reading.status, reading.raw_counts) == (None, Status.OUT_OF_RANGE, 36000)


def test_a_frame_that_is_too_short_is_a_failure_and_no_value() -> None:
    failure, reading = encoder().decode(START, b"\x4e\x61\xbc")
    assert isinstance(failure, DecodeFailure)
    assert failure.reason == "the frame has 3 bytes, the value needs 4"
    assert isinstance(reading, Reading)
    assert (reading.value, reading.status) == (None, Status.MALFORMED)
    (failure, reading) = linear().decode(START, b"")
    assert isinstance(failure, DecodeFailure)


def test_bytes_behind_the_mapped_objects_are_ignored() -> None:
    assert the_reading(encoder().decode(START, u32(16384) + b"\xff\xff")).value == 90.0


def test_a_pdo_without_position_is_refused_with_its_mapping() -> None:
    with pytest.raises(DescriptionError, match=r"theta1: TPDO1 of node 32 does not contain object 6004h.* 60300110"):
        encoder(SPEED)


@pytest.mark.parametrize("settings", [{"units_per_revolution": 0}, {"total_units": 0}, {"total_units": (1 << 32) + 1}])
def test_impossible_counts_are_refused(settings: dict[str, int]) -> None:
    with pytest.raises(DescriptionError, match="theta1: units_per_revolution"):
        encoder(**settings)


def test_an_alarm_is_told_once_and_voids_the_values_until_it_is_gone() -> None:
    decoder = encoder(POSITION, ALARMS)
    records = decoder.decode(START, u32(0) + b"\x01\x10")
    (event,) = events(records)
    assert (event.kind, event.code) == (EventKind.ALARM, 0x1001)
    assert event.text == "alarms (6503h): position error, manufacturer bit 12"
    assert [r.status for r in records if isinstance(r, Reading)] == [Status.DEVICE_ALARM]
    again = decoder.decode(at(0.02), u32(0) + b"\x01\x10")
    assert not events(again)
    assert [r.value for r in again if isinstance(r, Reading)] == [None]
    after = decoder.decode(at(0.04), u32(0) + bytes(2))
    assert [e.text for e in events(after)] == ["alarms (6503h) have cleared"]
    assert [r.status for r in after if isinstance(r, Reading)] == [Status.OK]


def test_a_warning_is_told_and_leaves_the_value() -> None:
    decoder = encoder(POSITION, WARNINGS)
    records = decoder.decode(START, u32(16384) + b"\x10\x00")
    assert [e.text for e in events(records)] == ["warnings (6505h): battery charge low"]
    assert the_reading(records).value == 90.0
    assert [e.text for e in events(decoder.decode(START, u32(16384) + bytes(2)))] == ["warnings (6505h) have cleared"]


def test_alarm_and_warning_bits_have_the_names_of_the_profile() -> None:
    decoder = encoder(POSITION, ALARMS, WARNINGS)
    alarms, warnings = events(decoder.decode(START, u32(0) + b"\x83\x10" + b"\x3f\x00"))
    assert alarms.text == (
        "alarms (6503h): position error, commissioning diagnostics, reserved bit 7, manufacturer bit 12"
    )
    assert warnings.text.startswith(
        "warnings (6505h): frequency or speed exceeded, light control reserve, CPU watchdog"
    )


def jumps(records: list[Record]) -> list[str]:
    return [event.text for event in events(records) if event.kind is EventKind.PRESET_JUMP]


def test_a_preset_jump_is_told_once_with_from_and_to_and_its_sample_is_not_used() -> None:
    decoder = encoder(max_rate_per_s=20.0)
    assert not jumps(decoder.decode(at(0.00), u32(10000)))
    records = decoder.decode(at(0.02), u32(0))
    (text,) = jumps(records)
    assert "from 54.9316 to 0.0000 deg" in text
    assert (the_reading(records).value, the_reading(records).status) == (None, Status.OUT_OF_RANGE)
    after = decoder.decode(at(0.04), u32(1))
    assert not jumps(after)
    assert the_reading(after).status is Status.OK


def test_motion_up_to_the_fastest_rate_is_no_jump_nor_is_the_wrap() -> None:
    decoder = encoder(max_rate_per_s=20.0)
    for step in range(1000):
        counts = 65000 + round(step * 0.02 * 20.0 * 65536 / 360)
        assert not jumps(decoder.decode(at(step * 0.02), u32(counts % 65536)))


def test_a_long_silence_explains_a_long_way() -> None:
    decoder = encoder(max_rate_per_s=20.0)
    decoder.decode(at(0), u32(0))
    assert not jumps(decoder.decode(at(10), u32(30000)))


READ_EVERY = 0.02
FASTEST = 20.0 * 65536 / 360  # counts in a second


def read_late(decoder: EncoderDecoder, pieces: list[tuple[float, float]], queue: int) -> list[str]:
    """Jumps told of a joint in fast motion whose reader is there, and is not, for these seconds in turn.

    Nothing but the first `queue` samples of the time without a reader waits for it; they come back to back.
    """
    told: list[str] = []
    now = 0.0
    for there_s, away_s in pieces:
        for _ in range(round(there_s / READ_EVERY)):
            now += READ_EVERY
            told += jumps(decoder.decode(at(now), u32(round(now * FASTEST) % 65536)))
        left, now = now, now + away_s
        for waited in range(min(queue, round(away_s / READ_EVERY))):
            counts = round((left + (waited + 1) * READ_EVERY) * FASTEST)
            told += jumps(decoder.decode(at(now + waited * 0.0005), u32(counts % 65536)))
        now += 0.01
    return told


@given(
    st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 8.0)), min_size=1, max_size=6), st.sampled_from([0, 10, 400])
)
def test_samples_that_nobody_read_in_time_are_no_jump(pieces: list[tuple[float, float]], queue: int) -> None:
    assert read_late(encoder(max_rate_per_s=20.0), [(0.1, 0.0), *pieces, (0.2, 0.0)], queue) == []


@given(st.lists(st.tuples(st.floats(0.0, 0.6), st.floats(0.0, 0.24)), max_size=12), st.floats(0.0001, 0.015))
def test_a_reader_that_is_held_up_for_moments_makes_no_jump(held_up: list[tuple[float, float]], each_s: float) -> None:
    """Also while it reads a backlog, of which each frame takes `each_s`."""
    decoder = encoder(max_rate_per_s=20.0)
    left = [
        (0.2 + sum(there + away for there, away in held_up[:i]) + held_up[i][0], held_up[i][1])
        for i in range(len(held_up))
    ]
    now = 0.0
    for number in range(1, 300):
        now = max(number * READ_EVERY, now + each_s)
        for begin, length in left:
            if begin <= now < begin + length:
                now = begin + length
        assert not jumps(decoder.decode(at(now), u32(round(number * READ_EVERY * FASTEST) % 65536)))


@given(st.integers(0, 1 << 30))
def test_noise_of_a_joint_that_stands_is_no_jump(seed: int) -> None:
    decoder, noise = encoder(max_rate_per_s=5.0), random.Random(seed)
    for number in range(300):
        counts = 30000 + round(noise.gauss(0.0, 10.0))  # 0.055 deg
        assert not jumps(decoder.decode(at(number * 0.01), u32(counts)))


@pytest.mark.parametrize("held_s", [0.025, 0.05, 0.1, 0.2])
def test_a_device_that_repeats_its_last_value_in_several_frames_makes_no_jump(held_s: float) -> None:
    decoder = encoder(max_rate_per_s=20.0)
    for number in range(1000):
        counts = round(int(number * 0.01 / held_s + 1e-9) * held_s * FASTEST) % 65536
        assert not jumps(decoder.decode(at(number * 0.01), u32(counts)))


def test_a_preset_is_told_again_once_a_backlog_must_be_read() -> None:
    decoder = encoder(max_rate_per_s=20.0)
    assert not read_late(decoder, [(1.0, 60.0)], 10)
    now = 61.5
    for _ in range(250):
        now += READ_EVERY
        decoder.decode(at(now), u32(0))
    assert jumps(decoder.decode(at(now + READ_EVERY), u32(2000)))


def test_without_a_fastest_rate_no_jump_is_looked_for() -> None:
    decoder = encoder()
    decoder.decode(at(0), u32(0))
    assert not events(decoder.decode(at(0.001), u32(30000)))


def test_a_linear_transducer_jumps_too() -> None:
    decoder = linear(max_rate_per_s=500.0)
    decoder.decode(at(0), u32(10000))
    records = decoder.decode(at(0.02), u32(0))
    assert "from 1000.0000 to 0.0000 mm" in jumps(records)[0]
    assert the_reading(records).value is None
    assert the_reading(decoder.decode(at(0.04), u32(0))).value == 0.0


def test_a_place_lost_behind_an_alarm_is_told_when_good_samples_return() -> None:
    decoder = encoder(POSITION, ALARMS, max_rate_per_s=20.0)
    decoder.decode(at(0), u32(10000) + bytes(2))
    for step in range(1, 10):
        bad = decoder.decode(at(0.02 * step), u32(16000) + b"\x01\0")
        assert the_reading(bad).status is Status.DEVICE_ALARM
    records = decoder.decode(at(0.2), u32(16000) + bytes(2))  # 33 deg further, 200 ms later
    assert "from 54.9316 to 87.8906 deg" in jumps(records)[0]
    assert (the_reading(records).value, the_reading(records).status) == (None, Status.OUT_OF_RANGE)
    assert not jumps(decoder.decode(at(0.22), u32(16000) + bytes(2)))


def test_a_place_lost_behind_an_emergency_or_a_restart_is_told() -> None:
    for restarts in (False, True):
        decoder = linear(max_rate_per_s=500.0)
        decoder.decode(at(0), u32(10000))
        decoder.is_void = True
        decoder.decode(at(0.02), u32(0))
        decoder.is_void = False
        if restarts:
            decoder.node_restarted()
        assert "from 1000.0000 to 0.0000 mm" in jumps(decoder.decode(at(0.04), u32(0)))[0]


def test_a_place_lost_behind_samples_out_of_range_or_too_short_is_told() -> None:
    for bad in (u32(30000), b"\0"):
        decoder = linear(max_rate_per_s=500.0, range_mm=(0.0, 2000.0))
        decoder.decode(at(0), u32(10000))
        decoder.decode(at(0.02), bad)
        assert jumps(decoder.decode(at(0.04), u32(0)))


def test_what_a_joint_can_move_behind_an_alarm_is_no_jump() -> None:
    decoder = encoder(POSITION, ALARMS, max_rate_per_s=20.0)
    decoder.decode(at(0), u32(0) + bytes(2))
    for step in range(1, 100):
        decoder.decode(at(0.02 * step), bytes(4) + b"\x01\0")
    assert not jumps(decoder.decode(at(2.0), u32(round(2.0 * FASTEST)) + bytes(2)))


def test_a_time_with_bad_samples_alone_is_no_time_that_nobody_read() -> None:
    decoder = encoder(POSITION, ALARMS, max_rate_per_s=20.0)
    decoder.decode(at(0), u32(0) + bytes(2))
    for step in range(1, 100):
        decoder.decode(at(0.02 * step), bytes(4) + b"\x01\0")
    decoder.decode(at(2.0), u32(0) + bytes(2))
    # 2 s behind an alarm allow for 2 s of motion once, and not again between the samples that follow
    assert jumps(decoder.decode(at(2.02), u32(2000) + bytes(2)))


def test_linear_value_from_step_sign_and_zero() -> None:
    # HYDAC HLT 1100: 6501h = 100000 nm
    assert the_reading(linear().decode(START, u32(15136))).value == 1513.6
    decoder = linear(step_nm=5000, sign=-1, zero_counts=1000)
    assert the_reading(decoder.decode(START, u32(-1000))).value == pytest.approx(10.0)


def test_a_length_beyond_the_range_has_no_value() -> None:
    decoder = linear(range_mm=(0.0, 2168.0))
    assert the_reading(decoder.decode(START, u32(21680))).value == pytest.approx(2168.0)
    for counts in (21681, -1):
        reading = the_reading(decoder.decode(START, u32(counts)))
        assert (reading.value, reading.status) == (None, Status.OUT_OF_RANGE)


def test_6004h_of_a_transducer_is_read_signed_or_unsigned_as_its_range_says() -> None:
    fine = {"position_object": 0x6004, "step_nm": 1}
    assert the_reading(linear(POSITION, range_mm=(-10, 10), **fine).decode(START, u32(-5))).raw_counts == -5
    unsigned = the_reading(linear(POSITION, range_mm=(0, 4000), **fine).decode(START, u32(3_000_000_000)))
    assert unsigned.value == pytest.approx(3000.0)
    records = linear(POSITION, range_mm=(-4000, 4000), **fine).decode(START, u32(3_000_000_000))
    assert the_reading(records).status is Status.MALFORMED
    assert any(isinstance(r, DecodeFailure) and "narrow it" in r.reason for r in records)


def test_an_impossible_step_is_refused() -> None:
    with pytest.raises(DescriptionError, match="L2: step_nm must be at least 1"):
        linear(step_nm=0)


def test_alarms_read_over_sdo_count_as_well_and_a_boot_up_ends_them() -> None:
    decoder = encoder()
    (event,) = events(decoder.object_read(START, 0x6503, 1))
    assert event.kind is EventKind.ALARM
    assert the_reading(decoder.decode(START, u32(0))).status is Status.DEVICE_ALARM
    assert events(decoder.object_read(START, 0x6505, 4))[0].kind is EventKind.WARNING
    assert not decoder.object_read(START, 0x6001, 4)
    decoder.node_restarted()
    assert the_reading(decoder.decode(START, u32(0))).status is Status.OK


@given(st.lists(st.binary(max_size=8), max_size=10), st.booleans())
def test_no_bytes_make_a_decoder_raise_or_give_a_number_that_is_none(frames: list[bytes], is_linear: bool) -> None:
    words = (SPEED, ALARMS, 0x60200120 if is_linear else POSITION)
    settings = {"max_rate_per_s": 20.0}
    decoder = linear(*words, **settings) if is_linear else encoder(*words, **settings)
    for number, data in enumerate(frames):
        for record in decoder.decode(at(number * 0.01), data):
            if isinstance(record, Reading):
                assert (record.status is Status.OK) == (record.value is not None)
                assert record.value is None or math.isfinite(record.value)
