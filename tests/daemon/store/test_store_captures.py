"""Captures survive their encoding exactly, and a damaged chunk is never taken for a good one."""

from __future__ import annotations

import contextlib
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.store.captures import decode_captures, decode_run, encode_captures, encode_large
from daemon.store.errors import StoreError
from daemon.store.packed_captures import packed, unpacked
from daemon.store.upkeep.packing import packed_run
from drivers.clock import Stamp
from drivers.readings import CanCapture, Capture, SerialCapture
from tests.daemon.support.store import at, frame, serial_bytes

INT64 = st.integers(-(2**63), 2**63 - 1)
STAMPS = st.builds(Stamp, INT64, INT64, st.sampled_from(["boot-a", "boot-b", "Anschluß"]), st.booleans())
CAN = st.builds(
    CanCapture,
    st.sampled_from(["boom", "feed"]),
    STAMPS,
    st.integers(0, 2**32 - 1),
    st.binary(max_size=64),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
SERIAL = st.builds(
    SerialCapture, st.sampled_from(["station", "zweite"]), STAMPS, st.binary(max_size=300), st.booleans()
)


@given(st.lists(CAN | SERIAL, max_size=40))
def test_every_field_of_every_capture_comes_back_in_order(captures: list[Capture]) -> None:
    chunks = encode_captures(captures)
    back = [capture for chunk in chunks for capture in decode_captures(chunk.blob)]
    for link in {c.link for c in captures}:
        assert [c for c in back if c.link == link] == [c for c in captures if c.link == link]
    assert len(back) == len(captures)


CYCLES = st.lists(st.tuples(INT64, st.integers(0, 3), st.binary(max_size=9), st.booleans()), min_size=1, max_size=60)


@given(CYCLES, st.booleans())
def test_a_large_chunk_gives_back_what_small_ones_held(cycle: list[tuple[int, int, bytes, bool]], serial: bool) -> None:
    """Stamps that jump anywhere, and few kinds of frames that come again and again, of any length."""
    captures: list[Capture] = [
        SerialCapture("station", Stamp(~ns, ns, "boot-a", doubt), data, doubt)
        if serial
        else CanCapture("boom", Stamp(ns // 3, ns, "boot-a"), number, data, is_error=doubt)
        for ns, number, data, doubt in cycle
    ]
    small = [chunk for start in range(0, len(captures), 7) for chunk in encode_captures(captures[start : start + 7])]
    large = packed_run([decode_run(chunk.blob) for chunk in small])
    assert decode_captures(large.blob) == captures
    assert (large.first, large.last) == (captures[0].stamp, captures[-1].stamp)


def test_a_minute_of_a_bus_in_one_chunk_takes_half_the_room_of_small_ones() -> None:
    """A SYNC cycle of nine encoders with noise in the last bits, and stamps that scatter as a kernel's do."""
    rng = np.random.default_rng(5)
    counts = np.cumsum(rng.normal(40.0, 3.0, (3000, 9)), axis=0) + rng.normal(0.0, 2.0, (3000, 9))
    late_ns = np.cumsum(230_000 + rng.exponential(15_000.0, (3000, 9)), axis=1) + 20_000_000 * np.arange(3000)[:, None]
    captures: list[Capture] = [
        CanCapture("boom", Stamp(10**18 + int(ns), int(ns), "boot-a"), 0x181 + node, struct.pack("<i", int(count)))
        for cycle, times in zip(counts, late_ns, strict=True)
        for node, (count, ns) in enumerate(zip(cycle, times, strict=True))
    ]
    small = [chunk for start in range(0, len(captures), 40) for chunk in encode_captures(captures[start : start + 40])]
    large = packed_run([decode_run(chunk.blob) for chunk in small])
    assert decode_captures(large.blob) == captures
    assert len(large.blob) < 4.0 * len(captures)  # of 16 bits of noise in a stamp and 5 in a count
    assert len(large.blob) < 0.5 * sum(len(chunk.blob) for chunk in small)


def test_a_chunk_says_what_it_holds() -> None:
    can, serial = encode_captures([frame(1), serial_bytes(b"Q+1", 0.0015), frame(2)])
    assert (can.link, can.kind, can.captures, can.payload_bytes) == ("boom", "can", 2, 16)
    assert (can.first, can.last) == (at(0.001), at(0.002))
    assert (serial.link, serial.kind, serial.captures, serial.payload_bytes) == ("station", "serial", 1, 3)


def test_each_boot_gets_a_chunk_of_its_own() -> None:
    chunks = encode_captures([frame(1), frame(2), frame(1, boot_id="boot-b")])
    assert [(c.first.boot_id, c.captures) for c in chunks] == [("boot-a", 2), ("boot-b", 1)]


def test_a_busy_bus_takes_less_room_than_its_frames_on_the_wire() -> None:
    (chunk,) = encode_captures([frame(n, n * 125e-6) for n in range(400)])
    assert len(chunk.blob) < 400 * 8


def test_a_frame_that_no_bus_can_carry_is_refused_by_name() -> None:
    with pytest.raises(StoreError, match=r"'boom'.*cannot be stored"):
        encode_captures([CanCapture("boom", at(0), 2**32, b"")])


def test_a_damaged_chunk_is_told_with_what_to_do() -> None:
    (chunk,) = encode_captures([frame(0)])
    with pytest.raises(StoreError, match=r"is damaged .*; restore the store from a backup"):
        decode_captures(chunk.blob[:-1] + bytes((chunk.blob[-1] ^ 1,)))


@given(st.data(), st.booleans())
def test_any_change_of_a_chunk_is_noticed(data: st.DataObject, is_large: bool) -> None:
    (chunk,) = encode_captures([frame(n) for n in range(5)])
    chunk = encode_large(decode_run(chunk.blob)) if is_large else chunk
    place = data.draw(st.integers(0, len(chunk.blob) - 1))
    change = data.draw(st.integers(1, 255))
    damaged = bytearray(chunk.blob)
    damaged[place] ^= change
    with pytest.raises(StoreError):
        decode_captures(bytes(damaged))
    with pytest.raises(StoreError):
        decode_captures(chunk.blob[:place])


def test_a_chunk_of_a_later_version_asks_for_a_newer_program() -> None:
    (chunk,) = encode_captures([frame(1)])
    later = bytearray(chunk.blob[:-4])
    later[4] = 4
    later += zlib.crc32(later).to_bytes(4, "little")
    with pytest.raises(StoreError, match="version 4"):
        decode_captures(bytes(later))


@pytest.mark.parametrize(
    ("place", "code", "value"), [(7 + 1, "<I", 2**31), (7 + 5, "<I", 7), (7 + 9, "<H", 60_000), (5, "B", 1)]
)
def test_a_chunk_that_was_written_wrongly_is_refused_though_its_checksum_is_right(
    place: int, code: str, value: int
) -> None:
    (chunk,) = encode_captures([frame(n) for n in range(200)])
    wrong = bytearray(chunk.blob[:-4])
    struct.pack_into(code, wrong, place, value)
    if code == "B":
        wrong[-20:] = bytes(20)  # the packed columns themselves
    wrong += zlib.crc32(wrong).to_bytes(4, "little")
    with pytest.raises(StoreError, match="is invalid"):
        decode_captures(bytes(wrong))


START = Stamp(1_700_000_000_000_000_000, 1_000_000_000, "boot")
WITHOUT_DOUBTS = {
    # As programs wrote them that knew no doubts
    "5243415001010100020000003400000004000400626f6f6d626f6f74780163603dc5308bc19a0101cc18fa197e31fc6598c3309d419c61c13f"
    "4609b01c37135409231300e3b40772480383d8": (
        CanCapture("boom", START, 0x1A0, b"\x01\x02"),
        CanCapture("boom", START.shifted(5), 0x18FE, b"", is_extended=True, is_remote=True, is_transmitted=True),
    ),
    "524341500102000001000000170000000700040073746174696f6e626f6f7400ca9a3b0000000000368ffafd9c97170002000000512bc58b8c"
    "dc": (SerialCapture("station", START, b"Q+"),),
}


@pytest.mark.parametrize("text", WITHOUT_DOUBTS)
def test_chunks_of_earlier_programs_are_read_and_those_without_doubts_are_written_as_ever(text: str) -> None:
    captures = list(WITHOUT_DOUBTS[text])
    assert decode_captures(bytes.fromhex(text)) == captures
    assert [chunk.blob.hex() for chunk in encode_captures(captures)] == [text]


def test_a_doubtful_time_survives_and_earlier_programs_refuse_it() -> None:
    captures: list[Capture] = [frame(1), replace(frame(2), stamp=frame(2).stamp.doubted()), frame(3)]
    (chunk,) = encode_captures(captures)
    assert decode_captures(chunk.blob) == captures
    assert [capture.stamp.is_doubtful for capture in decode_captures(chunk.blob)] == [False, True, False]
    assert chunk.blob[4] == 2


@given(st.data())
def test_a_large_chunk_that_was_written_wrongly_is_refused_or_is_some_captures(data: st.DataObject) -> None:
    """Its checksum is right: whatever the body says, nothing but a sentence or captures may come of it."""
    columns = decode_run(encode_captures([frame(n) for n in range(30)])[0].blob).columns
    body = bytearray(packed(columns, is_serial=False))
    for _ in range(data.draw(st.integers(1, 8))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(ValueError, IndexError):
        assert len(unpacked(bytes(body), 30, is_serial=False)) == 30
