from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.readings import Fix, LockState, Status
from drivers.stations.survey import METRES_PER_FOOT, RecordError, circle_angle_rad, position_mm, signed_circle_angle_rad
from drivers.stations.topcon.records import CorrectionScales, parse_record
from tests.drivers.serial_support import ANGLES, COORDINATES, SAMPLES, SLOPE_FINE, SLOPE_MM, TRACKING, at

DEFAULT_SCALES = CorrectionScales()


def dms(degrees: int, minutes: int, seconds: float) -> float:
    return math.radians(degrees + minutes / 60 + seconds / 3600)


def parsed(data: bytes, scales: CorrectionScales = DEFAULT_SCALES) -> Fix:
    return parse_record(data, "station", at(0), at(0.06), scales)


def with_field(sample: bytes, offset: int, value: bytes) -> bytes:
    """The sample's data with the characters from `offset` replaced."""
    data = sample[:-3]
    return data[:offset] + value + data[offset + len(value) :]


def test_a_slope_distance_record_in_mm() -> None:
    fix = parsed(SLOPE_MM[:-3])
    assert (fix.status, fix.lock, fix.reason) == (Status.OK, LockState.UNKNOWN, "")
    assert fix.slope_distance_m == pytest.approx(1.060, abs=1e-12)
    assert fix.zenith_angle_rad == pytest.approx(dms(90, 53, 56), abs=1e-12)
    assert fix.hz_angle_rad == pytest.approx(dms(354, 51, 5), abs=1e-12)
    assert (fix.face, fix.tilt_ok, fix.edm_level, fix.ppm, fix.prism_constant_mm) == (1, True, 60, 0, 0)
    assert (fix.stamp, fix.last_byte, fix.station, fix.raw) == (at(0), at(0.06), "station", SLOPE_MM[:-3])


def test_a_slope_distance_record_in_tenths_of_mm_in_face_2() -> None:
    fix = parsed(SLOPE_FINE[:-3])
    assert fix.status is Status.OK
    assert fix.slope_distance_m == pytest.approx(2.1760, abs=1e-12)
    assert fix.zenith_angle_rad == pytest.approx(dms(268, 22, 42.5), abs=1e-12)
    assert fix.hz_angle_rad == pytest.approx(dms(347, 6, 35.5), abs=1e-12)
    assert (fix.face, fix.tilt_ok, fix.edm_level) == (2, True, 0)


def test_an_angle_record_is_a_fix_without_a_position() -> None:
    fix = parsed(ANGLES[:-3])
    assert (fix.status, fix.reason) == (Status.NOT_AVAILABLE, "the record has only angles, no distance")
    assert fix.zenith_angle_rad == pytest.approx(dms(90, 53, 56), abs=1e-12)
    assert fix.hz_angle_rad == pytest.approx(dms(354, 51, 5), abs=1e-12)
    assert position_mm(fix) is None


def test_a_coordinate_record_in_mm() -> None:
    fix = parsed(COORDINATES[:-3])
    assert fix.status is Status.OK
    assert (fix.north_m, fix.east_m, fix.up_m) == pytest.approx((1234566.148, -23.344, -29.912), abs=1e-9)
    assert fix.hz_angle_rad == pytest.approx(dms(251, 56, 56), abs=1e-12)
    assert position_mm(fix) == pytest.approx((-23344, 1234566148, -29912), abs=1e-6)


def test_a_coordinate_record_in_tenths_of_mm_has_ten_digits_each() -> None:
    fix = parsed(b"/+0000123456-0000234567+0000000012m+2515656d")
    assert (fix.north_m, fix.east_m, fix.up_m) == pytest.approx((12.3456, -23.4567, 0.0012), abs=1e-9)


def test_a_coordinate_record_of_zeros_means_no_distance() -> None:
    for data in (b"U+00000000-00000000+00000000m+2515656d", b"/+0000000000+0000000000+0000000000m+2515656d"):
        fix = parsed(data)
        assert (fix.status, fix.reason, fix.east_m) == (Status.NOT_AVAILABLE, "no distance", None)
        assert position_mm(fix) is None
    assert parsed(b"U+00000000-00000001+00000000m+2515656d").status is Status.OK


@pytest.mark.parametrize(
    "coordinates",
    [b"+0000012345-00023344-00029912", b"+00012345-0000023344-00029912", b"+00012345-00023344-0000029912"],
)
def test_coordinates_of_one_record_have_one_width(coordinates: bytes) -> None:
    with pytest.raises(RecordError, match="layout"):
        parsed(b"U" + coordinates + b"m+2515656d")


def test_a_tracking_record_keeps_everything_the_instrument_said() -> None:
    fix = parsed(TRACKING[:-3])
    assert fix.slope_distance_m == pytest.approx(1178.4812, abs=1e-9)
    assert fix.zenith_angle_rad == pytest.approx(dms(85, 20, 30), abs=1e-12)
    assert fix.hz_angle_rad == pytest.approx(dms(120, 30, 40), abs=1e-12)
    assert (fix.face, fix.tilt_ok, fix.edm_level, fix.ppm, fix.prism_constant_mm) == (1, True, 15, 0, 2.5)
    assert (fix.status, fix.lock) == (Status.NOT_AVAILABLE, LockState.STANDBY)  # its flag is 0
    assert fix.reason == "tracking is switched off (flag 0)"


def test_the_horizontal_distance_of_the_tracking_sample_is_not_trusted() -> None:
    fix = parsed(with_field(TRACKING, 54, b"1"))
    position = position_mm(fix)
    assert position is not None
    # 1174.5883 m by SD and V; the record says 1174.5724, which contains a refraction correction.
    assert math.hypot(*position[:2]) / 1000 == pytest.approx(1174.5883, abs=5e-5)


@pytest.mark.parametrize(
    ("flag", "lock", "status"),
    [
        (b"0", LockState.STANDBY, Status.NOT_AVAILABLE),
        (b"1", LockState.LOCKED, Status.OK),
        (b"2", LockState.SEARCHING, Status.NOT_AVAILABLE),
        (b"3", LockState.WAITING, Status.NOT_AVAILABLE),
        (b"4", LockState.ROTATING, Status.NOT_AVAILABLE),
        (b"5", LockState.ROTATING, Status.NOT_AVAILABLE),
        (b"6", LockState.ERROR, Status.NOT_AVAILABLE),
        (b"9", LockState.UNKNOWN, Status.NOT_AVAILABLE),
    ],
)
def test_only_a_locked_station_gives_usable_fixes(flag: bytes, lock: LockState, status: Status) -> None:
    fix = parsed(with_field(TRACKING, 54, flag))
    assert (fix.lock, fix.status) == (lock, status)
    assert bool(fix.reason) == (status is not Status.OK)
    assert (position_mm(fix) is None) == (status is not Status.OK)


def test_distance_zero_means_no_distance() -> None:
    locked = with_field(TRACKING, 54, b"1")
    fix = parsed(locked.replace(b"+011784812", b"+000000000"))
    assert (fix.status, fix.slope_distance_m, fix.reason) == (Status.NOT_AVAILABLE, None, "no distance")
    assert position_mm(fix) is None


@pytest.mark.parametrize(
    ("tilt", "reason"), [(b"?", "out of range: level the instrument"), (b"*", "off: switch it on")]
)
def test_fixes_of_every_record_kind_are_unusable_while_the_compensator_is_off_or_out_of_range(
    tilt: bytes, reason: str
) -> None:
    for data in (
        with_field(SLOPE_MM, 36, tilt),
        with_field(SLOPE_FINE, 40, tilt),
        with_field(TRACKING[:40] + tilt + TRACKING[41:], 54, b"1"),
    ):
        fix = parsed(data)
        assert (fix.status, fix.tilt_ok) == (Status.OUT_OF_RANGE, False)
        assert fix.reason == f"the compensator is {reason}"
        assert position_mm(fix) is None


def test_a_return_level_of_asterisks_is_none() -> None:
    assert parsed(with_field(SLOPE_MM, 37, b"**")).edm_level is None


def test_the_scales_of_corrections_can_be_set() -> None:
    data = with_field(TRACKING, 43, b"-0123-030")
    fix = parsed(data)
    assert (fix.ppm, fix.prism_constant_mm) == pytest.approx((-12.3, -3.0))
    fix = parsed(data, CorrectionScales(ppm=1.0, prism_mm=1.0))
    assert (fix.ppm, fix.prism_constant_mm) == (-123, -30)
    fix = parsed(with_field(SLOPE_MM, 39, b"-05-30"))
    assert (fix.ppm, fix.prism_constant_mm) == (-5, -30)


def test_feet_become_metres() -> None:
    fix = parsed(with_field(SLOPE_MM, 10, b"f"))
    assert fix.slope_distance_m == pytest.approx(1.060 * METRES_PER_FOOT, abs=1e-12)
    fix = parsed(COORDINATES[:-3].replace(b"m", b"f"))
    assert fix.east_m == pytest.approx(-23.344 * METRES_PER_FOOT, abs=1e-12)


def test_feet_and_inches_are_refused_by_name() -> None:
    with pytest.raises(RecordError, match=r"feet and inches.*set the instrument to metres"):
        parsed(with_field(SLOPE_MM, 10, b"i"))


def test_gon_is_read_as_gon() -> None:
    assert circle_angle_rad("0970930", "g") == pytest.approx(math.radians(97.0930 * 0.9), abs=1e-12)
    assert circle_angle_rad("09709301", "g") == pytest.approx(math.radians(97.09301 * 0.9), abs=1e-12)
    fix = parsed(SLOPE_MM[:-3].replace(b"0905356", b"0970930").replace(b"d", b"g"))
    assert fix.zenith_angle_rad == pytest.approx(math.radians(97.0930 * 0.9), abs=1e-12)


def test_a_counter_clockwise_angle_is_the_same_direction_clockwise() -> None:
    assert signed_circle_angle_rad("-0900000", "d") == pytest.approx(dms(270, 0, 0))
    assert signed_circle_angle_rad("-0000000", "d") == 0.0


@pytest.mark.parametrize("digits", ["3600000", "0006000", "0000060", "00000600", "9999999"])
def test_an_impossible_angle_is_refused(digits: str) -> None:
    with pytest.raises(RecordError, match=digits):
        circle_angle_rad(digits, "d")


def test_400_gon_are_refused() -> None:
    with pytest.raises(RecordError, match="400 gon"):
        circle_angle_rad("4000000", "g")


def test_a_negative_distance_is_refused() -> None:
    with pytest.raises(RecordError, match="negative"):
        parsed(with_field(SLOPE_MM, 1, b"-"))


def test_a_horizontal_distance_that_contradicts_the_rest_is_refused() -> None:
    # Two digits of SD with the same bit wrong: the BCC does not see it.
    wrong = TRACKING[:-3].replace(b"+011784812", b"+033784812")
    with pytest.raises(RecordError, match="contradicts"):
        parsed(wrong)


@pytest.mark.parametrize("data", [b"", b"X123", b"Q", b"C", b"\xff" * 50, b"(" + b"\xb2" * 53])
def test_what_follows_no_layout_is_refused(data: bytes) -> None:
    with pytest.raises(RecordError):
        parsed(data)


def test_both_faces_give_the_same_position() -> None:
    record = b"?+00010000m%sd+00009962t60+00+00"
    face_1 = parsed(record % b"0850000+0300000")
    face_2 = parsed(record % b"2750000+2100000")
    assert (face_1.face, face_2.face) == (1, 2)
    assert position_mm(face_1) == pytest.approx(position_mm(face_2), abs=1e-9)
    zenith, hz = math.radians(85), math.radians(30)
    level_mm = 10_000 * math.sin(zenith)
    expected = (level_mm * math.sin(hz), level_mm * math.cos(hz), 10_000 * math.cos(zenith))
    assert position_mm(face_1) == pytest.approx(expected, abs=1e-9)


def test_a_fix_with_neither_distance_nor_coordinates_has_no_position() -> None:
    assert position_mm(Fix("station", at(0), at(0), Status.OK, LockState.UNKNOWN)) is None


def assert_sound(fix: Fix) -> None:
    """Every number of the fix is finite and in range; what is not usable says why."""
    for angle in (fix.hz_angle_rad, fix.zenith_angle_rad):
        assert angle is None or 0 <= angle < 2 * math.pi
    assert fix.slope_distance_m is None or 0 < fix.slope_distance_m < 1e5
    for metres in (fix.north_m, fix.east_m, fix.up_m):
        assert metres is None or abs(metres) < 1e7
    assert fix.face in (None, 1, 2)
    assert (fix.status is Status.OK) == (not fix.reason)
    assert (position_mm(fix) is not None) == (fix.status is Status.OK)


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_refused_or_sound(data: bytes) -> None:
    try:
        fix = parsed(data)
    except RecordError:
        return
    assert_sound(fix)


@given(
    st.sampled_from(SAMPLES),
    st.lists(st.tuples(st.integers(0, 58), st.sampled_from(b"0123456789+-mfidgt?*rl ")), max_size=6),
)
def test_damaged_records_are_refused_or_sound(sample: bytes, damage: list[tuple[int, int]]) -> None:
    data = bytearray(sample[:-3])
    for offset, value in damage:
        data[offset % len(data)] = value
    try:
        fix = parsed(bytes(data))
    except RecordError:
        return
    assert_sound(fix)
