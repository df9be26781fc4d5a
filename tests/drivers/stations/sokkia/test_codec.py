from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.readings import Fix, LockState, Status
from drivers.stations.replies import Frame, Garbage
from drivers.stations.sokkia.codec import SetFramer, checksum, instrument_codes, parse_identity, parse_reply
from drivers.stations.survey import RecordError, position_mm
from tests.drivers.serial_support import SET_REPLY, at


def parsed(data: bytes) -> Fix:
    return parse_reply(data, "station", at(0), at(0.03))


def pieces(data: bytes) -> list[tuple[str, bytes]]:
    return [
        ("line", item.data) if isinstance(item, Frame) else ("garbage", item.raw) for item in SetFramer().feed(data)
    ]


@pytest.mark.parametrize(
    ("data", "total"),
    [
        (b"1234567 1234567 1234567 ", b"A4"),
        (b"0006662 0804806 0394324 ", b"97"),
        (b"A SET2C,123456,4100,2506,", b"39"),
    ],
)
def test_the_checksum_is_that_of_the_protocol_facts(data: bytes, total: bytes) -> None:
    assert checksum(data) == total


def test_a_reply_with_its_checksum() -> None:
    fix = parsed(SET_REPLY)
    assert (fix.status, fix.lock, fix.face, fix.reason) == (Status.OK, LockState.UNKNOWN, 1, "")
    assert fix.slope_distance_m == pytest.approx(6.662, abs=1e-12)
    assert fix.zenith_angle_rad == pytest.approx(math.radians(80 + 48 / 60 + 6 / 3600), abs=1e-12)
    assert fix.hz_angle_rad == pytest.approx(math.radians(39 + 43 / 60 + 24 / 3600), abs=1e-12)
    assert (fix.stamp, fix.last_byte, fix.raw) == (at(0), at(0.03), SET_REPLY[:-3])


def test_a_reply_without_checksum() -> None:
    assert parsed(SET_REPLY[:-3]) == parsed(SET_REPLY)


def test_a_wrong_checksum_is_refused() -> None:
    with pytest.raises(RecordError, match="SUM is 98, computed 97"):
        parsed(SET_REPLY[:-2] + b"98")


def test_an_error_in_the_distance_leaves_the_angles() -> None:
    fix = parsed(b"E200 0804806 0394324")
    assert (fix.status, fix.slope_distance_m, fix.reason) == (Status.NOT_AVAILABLE, None, "slope distance: E200")
    assert fix.zenith_angle_rad is not None
    assert fix.hz_angle_rad is not None
    assert instrument_codes(fix) == (200,)


def test_errors_in_every_field_are_all_named() -> None:
    fix = parsed(b"E101 E114 E117")
    assert fix.reason == "slope distance: E101, zenith angle: E114, horizontal angle: E117"
    assert (fix.zenith_angle_rad, fix.hz_angle_rad, fix.face) == (None, None, None)
    assert instrument_codes(fix) == (101, 114, 117)


def test_distance_zero_means_no_distance() -> None:
    fix = parsed(b"0000000 0804806 0394324")
    assert (fix.status, fix.slope_distance_m, fix.reason) == (Status.NOT_AVAILABLE, None, "no distance")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"0006662 0804806",
        b"0006662  0804806 0394324",
        b"006662 0804806 0394324",
        b"00066622 0804806 0394324",
        b"0006662 0804860 0394324",
        b"0006662 0804806 3600000",
        b"0006662 0804806 0394324 9",
        b"0006662 0804806 0394324 97 97",
        b"hello",
    ],
)
def test_what_is_no_reply_is_refused(data: bytes) -> None:
    with pytest.raises(RecordError):
        parsed(data)


def test_the_identity_is_read_with_and_without_checksum() -> None:
    words = "SET2C, serial number 123456, ROM 4100, EDM 2506"
    assert parse_identity(b"A SET2C,123456,4100,2506,39") == words
    assert parse_identity(b"A SET2C,123456,4100,2506") == words


@pytest.mark.parametrize("data", [b"A SET2C,123456,4100,2506,38", b"A SET2C", b"A a,b,c,", b"B 1", b"A \xff,1,2,3"])
def test_what_is_no_identity_is_refused(data: bytes) -> None:
    with pytest.raises(RecordError):
        parse_identity(data)


@pytest.mark.parametrize("end", [b"\r\n", b"\r", b"\n"])
def test_lines_end_with_cr_lf_or_both(end: bytes) -> None:
    assert pieces(SET_REPLY + end + SET_REPLY + end) == [("line", SET_REPLY)] * 2


def test_acknowledgements_stand_alone() -> None:
    assert pieces(b"\x06" + SET_REPLY + b"\r\n\x15") == [("line", b"\x06"), ("line", SET_REPLY), ("line", b"\x15")]
    assert pieces(b"0006\x06") == [("garbage", b"0006"), ("line", b"\x06")]


def test_clutter_before_a_reply_costs_only_the_clutter() -> None:
    assert pieces(b"\xff+" + SET_REPLY + b"\r\n") == [("garbage", b"\xff+"), ("line", SET_REPLY)]


def test_digits_before_a_reply_are_not_cut_off() -> None:
    assert pieces(b"1" + SET_REPLY + b"\r\n") == [("line", b"1" + SET_REPLY)]


def test_offsets_are_those_of_the_first_and_the_last_byte_in_the_stream() -> None:
    framer = SetFramer()
    assert framer.feed(b"\r\n\x06#" + SET_REPLY[:5]) == [Frame(b"\x06", 2, 2)]
    assert framer.pending == 6
    assert framer.feed(SET_REPLY[5:] + b"\r") == [
        Garbage(b"#", "garbage before a reply", 3, 3),
        Frame(SET_REPLY, 4, 3 + len(SET_REPLY)),
    ]
    framer.feed(b"00")
    assert framer.flush("broken off") == [Garbage(b"00", "broken off", 31, 32)]


def test_an_endless_line_is_given_up_in_pieces_and_the_next_reply_is_found() -> None:
    found = pieces(b"x" * 300 + b"\r\n" + SET_REPLY + b"\r\n")
    assert [(kind, len(data)) for kind, data in found] == [
        ("garbage", 128),
        ("garbage", 128),
        ("line", 44),
        ("line", len(SET_REPLY)),
    ]


@given(
    st.lists(st.one_of(st.binary(max_size=300), st.sampled_from([SET_REPLY + b"\r\n", b"\x06", b"E100 "])), max_size=9),
    st.integers(1, 40),
)
def test_any_bytes_in_any_portions_are_framed_alike_and_all_accounted_for(parts: list[bytes], size: int) -> None:
    data = b"".join(parts)
    whole = SetFramer().feed(data)
    framer, portions = SetFramer(), []
    for start in range(0, len(data), size):
        portions += framer.feed(data[start : start + size])
        assert framer.pending < 128
    assert portions == whole
    portions += framer.flush("end")
    covered = [position for item in portions for position in range(item.start, item.end + 1)]
    assert covered == sorted(set(covered))
    for item in portions:
        assert data[item.start : item.end + 1] == (item.data if isinstance(item, Frame) else item.raw)
    assert {data[position] for position in set(range(len(data))) - set(covered)} <= set(b"\r\n")


@given(
    st.one_of(st.binary(max_size=40), st.from_regex(rb"(\d{7}|E\d{3}) (\d{7}|E\d{3}) (\d{7}|E\d{3})", fullmatch=True))
)
def test_arbitrary_bytes_are_refused_or_sound(data: bytes) -> None:
    try:
        fix = parsed(data)
    except RecordError:
        return
    for angle in (fix.hz_angle_rad, fix.zenith_angle_rad):
        assert angle is None or 0 <= angle < 2 * math.pi
    assert fix.slope_distance_m is None or 0 < fix.slope_distance_m < 1e4
    assert (position_mm(fix) is not None) == (fix.status is Status.OK) == (not fix.reason)
