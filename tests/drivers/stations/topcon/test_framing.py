from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.stations.replies import Frame, Garbage
from drivers.stations.topcon.framing import RECORD_HEADERS, GtsFramer, block_check, decode_frame, encode_frame
from tests.drivers.serial_support import ACK_FRAME, SAMPLES, SLOPE_MM, TRACKING, framed

# docs/reference/protocols.md 1.2, 1.3 and 1.6.
CHECKED = [
    (b"C", b"067"),
    (b"Z12", b"089"),
    (b"Z20", b"088"),
    (b"Z32", b"091"),
    (b"Z34", b"093"),
    (b"Z64", b"088"),
    (b"J", b"074"),
    (b"J+1234500d", b"052"),
    (b"\x06", b"006"),
    (b"\x15", b"021"),
    (b"C11", b"067"),
    (b"C31", b"065"),
    (b"T34", b"083"),
    (b"T30", b"087"),
    (b"T13+0000000+0900000d", b"059"),
    (b"T20" + b"0", b"102"),
    (b"ZB1+0000000d", b"086"),
    (b"ZB23", b"025"),
    (b"ZB4+", b"007"),
    (b"ZB52", b"031"),
    (b"ZB61", b"031"),
    (b"ZC2010010d", b"079"),
    (b"ZD30010", b"044"),
    (b"ZD50", b"027"),
    (b"G8SW1", b"074"),
    (b"G8SW0", b"075"),
]


def frames(*chunks: bytes) -> list[bytes]:
    """Data of the frames in `chunks`; garbage fails."""
    framer = GtsFramer()
    found = [item for chunk in chunks for item in framer.feed(chunk)]
    assert all(isinstance(item, Frame) for item in found), found
    return [item.data for item in found if isinstance(item, Frame)]


def pieces(data: bytes) -> list[tuple[str, bytes]]:
    """Return the pieces of `data`: ("frame", data) and ("garbage", raw)."""
    return [
        ("frame", item.data) if isinstance(item, Frame) else ("garbage", item.raw) for item in GtsFramer().feed(data)
    ]


@pytest.mark.parametrize(("data", "bcc"), CHECKED)
def test_the_block_check_is_that_of_the_protocol_facts(data: bytes, bcc: bytes) -> None:
    assert block_check(data) == bcc


@pytest.mark.parametrize("sample", SAMPLES)
def test_the_samples_have_the_block_check_that_they_carry(sample: bytes) -> None:
    assert block_check(sample[:-3]) == sample[-3:]
    assert decode_frame(sample) == sample[:-3]


def test_commands_are_framed_byte_for_byte_with_and_without_crlf() -> None:
    assert encode_frame(b"C", crlf=True) == bytes.fromhex("43 30 36 37 03 0D 0A")
    assert encode_frame(b"C11", crlf=True) == bytes.fromhex("43 31 31 30 36 37 03 0D 0A")
    assert encode_frame(b"\x06", crlf=False) == bytes.fromhex("06 30 30 36 03")


@pytest.mark.parametrize("end", [b"\x03", b"\x03\r\n", b"\x03\r", b"\x03\n"])
def test_frames_end_at_etx_with_or_without_crlf(end: bytes) -> None:
    assert frames(SLOPE_MM + end + TRACKING + end) == [SLOPE_MM[:-3], TRACKING[:-3]]


def test_an_acknowledgement_and_a_record_in_one_buffer_are_two_frames() -> None:
    assert frames(ACK_FRAME + SLOPE_MM + b"\x03\r\n") == [b"\x06", SLOPE_MM[:-3]]


def test_an_acknowledgement_that_lost_its_06h_and_its_etx_is_still_told_from_the_record() -> None:
    assert frames(b"006" + SLOPE_MM + b"\x03") == [b"\x06", SLOPE_MM[:-3]]
    assert frames(b"006\x03") == [b"\x06"]


def test_a_space_after_06h_is_tolerated() -> None:
    assert frames(bytes.fromhex("06 20 30 30 36 03")) == [b"\x06"]
    assert frames(b"\x06 006" + SLOPE_MM + b"\x03") == [b"\x06", SLOPE_MM[:-3]]


def test_a_refusal_is_a_frame() -> None:
    assert frames(bytes.fromhex("15 30 32 31 03")) == [b"\x15"]


def test_a_record_whose_etx_was_lost_is_found_before_the_next_one() -> None:
    assert frames(SLOPE_MM + b"\r\n" + TRACKING + b"\x03") == [SLOPE_MM[:-3], TRACKING[:-3]]


def test_a_wrong_block_check_is_garbage_that_keeps_every_byte() -> None:
    wrong = TRACKING[:-1] + b"2"
    (item,) = GtsFramer().feed(wrong + b"\x03\r\n")
    assert item == Garbage(wrong, "BCC is 122, computed 121", 0, len(wrong))


@pytest.mark.parametrize("clutter", [b"\x00\xff", b"+++", b"OK", b"\x06", b"Q+0117848", b"\r\nRING\r\n"])
def test_clutter_before_a_record_costs_only_the_clutter(clutter: bytes) -> None:
    assert pieces(clutter + TRACKING + b"\x03") == [("garbage", clutter.strip(b"\r\n")), ("frame", TRACKING[:-3])]


def test_a_header_character_inside_a_record_does_not_split_it() -> None:
    over_range = SLOPE_MM[:36] + b"?" + SLOPE_MM[37:-3]
    assert frames(framed(over_range)) == [over_range]


def test_an_etx_alone_is_garbage() -> None:
    assert pieces(b"\x03\r\n") == [("garbage", b"\x03")]


def test_offsets_are_those_of_the_first_and_the_last_byte_in_the_stream() -> None:
    framer = GtsFramer()
    assert framer.feed(ACK_FRAME[:3]) == []
    assert framer.feed(ACK_FRAME[3:] + b"\xff" + TRACKING + b"\x03\r\n") == [
        Frame(b"\x06", 0, 4),
        Garbage(b"\xff", "not a frame: expected printable data and three digits of BCC before ETX", 7, 7),
        Frame(TRACKING[:-3], 8, 8 + len(TRACKING)),
    ]


def test_an_endless_line_is_given_up_in_pieces_and_the_next_record_is_found() -> None:
    framer = GtsFramer()
    found = framer.feed(b"x" * 1000)
    assert [len(item.raw) for item in found if isinstance(item, Garbage)] == [128] * 6
    assert framer.pending < 256
    found = framer.feed(TRACKING + b"\x03")
    assert isinstance(found[-1], Frame)
    assert found[-1].data == TRACKING[:-3]


def test_flushing_gives_up_what_is_pending_with_the_reason() -> None:
    framer = GtsFramer()
    framer.feed(b"\r\nQ+01")
    assert framer.flush("broken off") == [Garbage(b"Q+01", "broken off", 2, 5)]
    assert framer.flush("broken off") == []


pieces_of_line = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([*(sample + b"\x03\r\n" for sample in SAMPLES), ACK_FRAME, b"006", b"\x03", b"?", b"Q"]),
)


@given(st.lists(pieces_of_line, max_size=20), st.integers(1, 50))
def test_any_bytes_in_any_portions_are_framed_alike_and_all_accounted_for(parts: list[bytes], size: int) -> None:
    data = b"".join(parts)
    whole = GtsFramer().feed(data)
    framer, portions = GtsFramer(), []
    for at in range(0, len(data), size):
        portions += framer.feed(data[at : at + size])
        assert framer.pending < 256
    assert portions == whole
    portions += framer.flush("end")
    covered = sorted(position for item in portions for position in range(item.start, item.end + 1))
    assert len(covered) == len(set(covered))
    assert {data[position] for position in set(range(len(data))) - set(covered)} <= set(b"\r\n\x03")
    for item in portions:
        assert decode_frame(framed(item.data)[:-3]) is not None if isinstance(item, Frame) else item.raw


def is_one_frame(data: bytes) -> bool:
    """True unless a record after clutter whose XOR is 0 would have the same block check: the record is taken then."""
    return all(block_check(data[:at]) != b"000" for at in range(1, len(data)) if data[at] in RECORD_HEADERS)


def test_of_two_readings_of_a_frame_the_record_is_taken() -> None:
    assert pieces(encode_frame(b"  /", crlf=True)) == [("garbage", b"  "), ("frame", b"/")]


@given(st.binary(min_size=1, max_size=100).filter(lambda data: all(32 <= byte < 127 for byte in data)))
def test_what_is_encoded_is_decoded(data: bytes) -> None:
    assume(is_one_frame(data))
    assert data in frames(encode_frame(data, crlf=True)) or data == b"006"[: len(data)]
