from __future__ import annotations

import struct

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.frame import Frame, SlcanLines, parse_can_frame, parse_multicast, slcan_line


def can_frame(identifier: int, data: bytes, length: int | None = None) -> bytes:
    """Make a `struct can_frame` of linux/can.h."""
    return struct.pack("=IB3x8s", identifier, len(data) if length is None else length, data)


def test_a_data_frame_of_socketcan() -> None:
    assert parse_can_frame(can_frame(0x1A0, bytes(4))) == Frame(0x1A0, bytes(4))
    assert parse_can_frame(can_frame(0x8CFE3021, b"\x7d")) == Frame(0x0CFE3021, b"\x7d", is_extended=True)


def test_a_remote_frame_of_socketcan_has_no_data() -> None:
    assert parse_can_frame(can_frame(0x400001A0, b"", 4)) == Frame(0x1A0, b"", is_remote=True)


def test_an_error_frame_of_socketcan_keeps_its_class() -> None:
    assert parse_can_frame(can_frame(0x20000204, bytes(8))) == Frame(0x204, bytes(8), is_error=True)


@pytest.mark.parametrize("datagram", [b"", bytes(72), can_frame(1, b"", 9)])
def test_what_is_no_classic_frame_of_socketcan_is_none(datagram: bytes) -> None:
    assert parse_can_frame(datagram) is None


def test_messages_as_python_can_packs_them_for_multicast() -> None:
    message = can.Message(timestamp=1.5, arbitration_id=0x1A0, data=b"\x01\x02", is_extended_id=False)
    assert parse_multicast(pack_message(message)) == (Frame(0x1A0, b"\x01\x02"), 1.5)
    remote = can.Message(arbitration_id=0x0CFE3021, is_remote_frame=True)
    assert parse_multicast(pack_message(remote)) == (Frame(0x0CFE3021, b"", is_extended=True, is_remote=True), 0.0)
    error = can.Message(arbitration_id=0x204, is_error_frame=True, data=bytes(8))
    assert parse_multicast(pack_message(error)) == (Frame(0x204, bytes(8), is_error=True), 0.0)


GOOD = msgpack.unpackb(pack_message(can.Message(arbitration_id=1, is_extended_id=False)))


@pytest.mark.parametrize(
    "change",
    [
        {"arbitration_id": "1"},
        {"arbitration_id": -1},
        {"arbitration_id": 0x800},
        {"data": "text"},
        {"data": bytes(9)},
        {"is_fd": True},
        {"timestamp": None},
    ],
)
def test_a_message_that_is_no_classic_frame_is_none(change: dict[str, object]) -> None:
    assert parse_multicast(msgpack.packb(GOOD)) is not None
    assert parse_multicast(msgpack.packb(GOOD | change)) is None


@given(st.binary(max_size=40))
def test_no_datagram_makes_a_parser_raise(datagram: bytes) -> None:
    parse_multicast(datagram)
    parse_can_frame(datagram)
    parse_can_frame(datagram[:16].ljust(16, b"\0"))


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("t1A044E61BC00", Frame(0x1A0, bytes.fromhex("4E61BC00"))),
        ("t1a00", Frame(0x1A0, b"")),
        ("T0CFE302117D", Frame(0x0CFE3021, b"\x7d", is_extended=True)),
        ("r1A04", Frame(0x1A0, b"", is_remote=True)),
        ("R0CFE30210", Frame(0x0CFE3021, b"", is_extended=True, is_remote=True)),
        ("t1A02AABB1234", Frame(0x1A0, b"\xaa\xbb")),
        ("r1A041234", Frame(0x1A0, b"", is_remote=True)),
    ],
)
def test_lines_of_an_adapter(line: str, frame: Frame) -> None:
    lines = SlcanLines()
    assert lines.feed(line.encode() + b"\r") == [frame]
    assert lines.malformed == 0


@pytest.mark.parametrize(
    ("line", "error_class", "data"),
    [
        ("sa057033", 0x004, "0040000000002139"),
        ("sw000097", 0x004, "000c000000006100"),
        ("sp128000", 0x004, "0030000000000080"),
        ("sb256256", 0x040, "000000000000ffff"),
        ("e1a", 0x020, "0000000000000000"),
        ("e3bcO", 0x08C, "0002080800000000"),
    ],
)
def test_lines_about_errors_are_the_error_frames_that_socketcan_would_give(
    line: str, error_class: int, data: str
) -> None:
    lines = SlcanLines()
    assert lines.feed(line.encode() + b"\r") == [Frame(error_class, bytes.fromhex(data), is_error=True)]
    assert lines.malformed == 0


def test_lines_may_arrive_in_any_pieces_and_between_answers() -> None:
    stream = b"\r\az\rV1013\rt1A02AABB\rZ\rt1A11CC\r"
    for size in range(1, len(stream)):
        lines = SlcanLines()
        frames = [f for start in range(0, len(stream), size) for f in lines.feed(stream[start : start + size])]
        assert frames == [Frame(0x1A0, b"\xaa\xbb"), Frame(0x1A1, b"\xcc")]
        assert lines.malformed == 0


@pytest.mark.parametrize(
    "line", [b"t1A0", b"t1A04AABB", b"t8001AA", b"T200000000", b"t1A09", b"x", b"t1A02AABB12", b"e2a", b"sx000000"]
)
def test_a_line_that_is_no_frame_is_counted(line: bytes) -> None:
    lines = SlcanLines()
    assert lines.feed(line + b"\r") == []
    assert lines.malformed == 1


@pytest.mark.parametrize(
    "line",
    [
        b"t1A04AABBCCDDt1A04AABBCCDE",
        b"t1A04AABBCCDD1234t1A04AABBCCDE",
        b"r1A04t1A01AA",
        b"r1A0412345678",
        b"zt1A01AA",
        b"F00t1A01AA",
    ],
)
def test_two_lines_whose_end_was_lost_between_them_are_counted_and_give_no_frame(line: bytes) -> None:
    lines = SlcanLines()
    assert lines.feed(b"t1A00\r" + line + b"\rt1A10\r") == [Frame(0x1A0, b""), Frame(0x1A1, b"")]
    assert lines.malformed == 1


@pytest.mark.parametrize(
    ("before", "line"),
    [
        (b"t1A02AABB0001", b"t1A02AABB"),
        (b"t1A04AABBCCDD0001", b"t1A04CCDD0002"),
        (b"t1A02AABB", b"t1A02AABB0001"),
        (b"t1A02AABB", b"r1A02AABB"),
    ],
)
def test_a_line_that_lost_or_gained_the_digits_of_a_timestamp_is_counted_and_gives_no_frame(
    before: bytes, line: bytes
) -> None:
    lines = SlcanLines()
    assert len(lines.feed(before + b"\r")) == 1
    assert lines.feed(2 * (line + b"\r")) == []
    assert lines.malformed == 2
    assert len(lines.feed(before + b"\r")) == 1
    assert lines.feed(2 * (line + b"\r")) == [], "counted anew, as the lines were not in a row"


def test_timestamps_that_an_adapter_begins_to_send_are_taken_for_such_after_three_lines() -> None:
    lines = SlcanLines()
    assert len(lines.feed(b"t1A02AABB\r")) == 1
    assert lines.feed(5 * b"t1A02AABB0001\r") == 3 * [Frame(0x1A0, b"\xaa\xbb")]
    assert lines.malformed == 2
    assert lines.feed(b"t1A02AABB\r") == []


@pytest.mark.parametrize("line", [b"z", b"Z", b"F00", b"F8a", b"V1013", b"NA123"])
def test_answers_of_an_adapter_are_no_lost_lines(line: bytes) -> None:
    lines = SlcanLines()
    assert lines.feed(line + b"\r") == []
    assert lines.malformed == 0


@given(
    identifier=st.integers(0, 2**29 - 1),
    data=st.binary(max_size=8),
    stamp=st.sampled_from(["", "1A2F"]),
    end=st.sampled_from(["\r", "\r\n"]),
    is_lower=st.booleans(),
)
def test_a_frame_of_any_identifier_is_the_line_of_it(
    identifier: int, data: bytes, stamp: str, end: str, is_lower: bool
) -> None:
    digits = f"{len(data)}{data.hex().upper()}{stamp}"
    lines = [f"{identifier:08X}{digits}", f"{identifier % 2048:03X}{digits}"]
    extended, standard = [line.lower() if is_lower else line for line in lines]
    lines_of = SlcanLines()
    expected = [Frame(identifier, data, is_extended=True), Frame(identifier % 2048, data)]
    assert lines_of.feed(f"T{extended}{end}t{standard}{end}".encode()) == expected
    assert lines_of.malformed == 0


def test_noise_without_an_end_is_dropped() -> None:
    lines = SlcanLines()
    for _ in range(10):
        lines.feed(bytes(20))
    assert lines.malformed == 2
    lines.feed(b"\r")
    assert lines.feed(b"t1A00\r") == [Frame(0x1A0, b"")]


@given(st.lists(st.binary(max_size=30), max_size=10))
def test_no_bytes_of_an_adapter_make_the_parser_raise(pieces: list[bytes]) -> None:
    lines = SlcanLines()
    for piece in pieces:
        for frame in lines.feed(piece):
            assert len(frame.data) <= 8


@given(
    st.one_of(
        st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(False), st.just(False), st.just(False)),
        st.builds(
            Frame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(True), st.just(False), st.just(False)
        ),
        st.builds(Frame, st.integers(0, 0x7FF), st.just(b""), st.just(False), st.just(True), st.just(False)),
    )
)
def test_the_line_that_sends_a_frame_is_the_line_that_receives_it(frame: Frame) -> None:
    assert SlcanLines().feed(slcan_line(frame)) == [frame]
