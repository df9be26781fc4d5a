from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.logs.can_log import FORMATS, read_can_log, write_can_log
from drivers.readings import CanCapture

START_NS = 1_700_000_000_123_456_000


def stamp(utc_ns: int) -> Stamp:
    return Stamp(utc_ns, utc_ns, "log")


CAPTURES = [
    *(CanCapture("can0", stamp(START_NS + n * 1_234_000), 0x1A0 + n, bytes(range(n))) for n in range(9)),
    CanCapture("can0", stamp(START_NS + 20_000_000), 0x18FECA00, b"\xff\x00", is_extended=True),
    CanCapture("can0", stamp(START_NS + 20_001_000), 0x05, b"\x01", is_extended=True),
    CanCapture("can1", stamp(START_NS + 21_000_000), 0x080, b"", is_transmitted=True),
    CanCapture("can0", stamp(START_NS + 22_000_000), 0x123, b"", is_remote=True),
    CanCapture("can0", stamp(START_NS + 4000_000_000_000), 0x7FF, bytes(8)),
]
ERRORS = [
    CanCapture("can0", stamp(START_NS + 30_000_000), 0x204, bytes.fromhex("0008000000000506"), is_error=True),
    CanCapture("can0", stamp(START_NS + 31_000_000), 0x040, b"", is_error=True),
]


def log(tmp_path: Path, text: str, suffix: str = ".log") -> Path:
    path = tmp_path / f"boom{suffix}"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_log_survives_a_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"boom{suffix}"
    assert write_can_log(path, CAPTURES) == len(CAPTURES)
    assert list(read_can_log(path)) == CAPTURES


@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_error_frames_survive_with_their_class(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"boom{suffix}"
    write_can_log(path, ERRORS)
    assert list(read_can_log(path)) == ERRORS


def test_an_asc_file_keeps_of_an_error_frame_that_there_was_one(tmp_path: Path) -> None:
    path = tmp_path / "boom.asc"
    write_can_log(path, ERRORS)
    assert [(c.stamp, c.is_error, c.arbitration_id, c.data) for c in read_can_log(path)] == [
        (error.stamp, True, 0, b"") for error in ERRORS
    ]


@pytest.mark.parametrize("utc_ns", [1_700_000_000_005_000_000, 1_700_000_000_050_007_000, 1_699_999_999_999_999_000])
def test_an_asc_file_keeps_instants_whatever_the_millisecond_of_its_start(tmp_path: Path, utc_ns: int) -> None:
    path = tmp_path / "boom.asc"
    write_can_log(path, [CanCapture("can0", stamp(utc_ns), 1, b"")])
    assert [capture.stamp.utc_ns for capture in read_can_log(path)] == [utc_ns]


@pytest.mark.parametrize("suffix", FORMATS)
def test_all_frames_may_be_given_to_one_link(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"boom{suffix}"
    write_can_log(path, CAPTURES)
    assert list(read_can_log(path, "boom")) == [dataclasses.replace(c, link="boom") for c in CAPTURES]


def test_candump_keeps_link_names_and_vector_formats_number_them(tmp_path: Path) -> None:
    captures = [dataclasses.replace(c, link={"can0": "boom", "can1": "feed"}[c.link]) for c in CAPTURES]
    write_can_log(tmp_path / "a.log", captures)
    assert list(read_can_log(tmp_path / "a.log")) == captures
    for suffix in (".asc", ".blf"):
        write_can_log(tmp_path / f"a{suffix}", captures)
        assert list(read_can_log(tmp_path / f"a{suffix}")) == CAPTURES


def test_an_empty_log_has_no_frames(tmp_path: Path) -> None:
    for suffix in FORMATS:
        assert write_can_log(tmp_path / f"empty{suffix}", []) == 0
        assert list(read_can_log(tmp_path / f"empty{suffix}")) == []


def test_lines_of_candump_itself_are_read(tmp_path: Path) -> None:
    text = (
        "(1700000000.123456) can0 1A0#4E61BC00\n"
        "\n"
        "(1700000000.5) vcan1 0CFE3021#7DFF\n"
        " (1700000001.000000001) can0 123#R8\n"
        "(1700000002.000000) can0 20000004#0004000000000000 R\n"
        "(1700000003.000000) can0 080# T\n"
    )
    frames = list(read_can_log(log(tmp_path, text)))
    assert [
        (c.link, c.arbitration_id, c.data, c.is_extended, c.is_remote, c.is_error, c.is_transmitted) for c in frames
    ] == [
        ("can0", 0x1A0, bytes.fromhex("4E61BC00"), False, False, False, False),
        ("vcan1", 0x0CFE3021, b"\x7d\xff", True, False, False, False),
        ("can0", 0x123, b"", False, True, False, False),
        ("can0", 0x004, bytes.fromhex("0004000000000000"), False, False, True, False),
        ("can0", 0x080, b"", False, False, False, True),
    ]
    assert frames[0].stamp == stamp(1_700_000_000_123_456_000)
    assert frames[1].stamp == stamp(1_700_000_000_500_000_000)
    assert frames[2].stamp == stamp(1_700_000_001_000_000_001)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("garbage", "not a candump line"),
        ("(1700000000.0) can0 1A0#4E61BC0", "not a candump line"),
        ("(1700000000.0) can0 1A0#000102030405060708", "not a candump line"),
        ("(1700000000.0) can0 1A#00", "not a candump line"),
        ("(now) can0 1A0#00", "not a candump line"),
        ("(1700000000.0) can0 1A0##100", "CAN FD frames are not supported"),
        ("(1700000000.0) can0 8FF#00", "identifier 8FF is too large"),
        ("(1700000000.0) can0 40000001#00", "identifier 40000001 is too large"),
        ("(1700000000.0) can0 1A0#\u00e9\u00e9", "not a candump line"),
        ("(9999999999.0) can0 1A0#00", "time is before 1970 or after 2262"),
    ],
)
def test_a_malformed_candump_line_is_refused_with_its_number(tmp_path: Path, line: str, reason: str) -> None:
    path = log(tmp_path, f"(1700000000.0) can0 1A0#00\n{line}\n")
    frames = read_can_log(path)
    assert next(frames).arbitration_id == 0x1A0
    with pytest.raises(DescriptionError, match=reason) as caught:
        next(frames)
    assert str(caught.value).startswith(f"{path}:2: ")


def test_a_candump_log_whose_last_frame_may_be_cut_is_refused(tmp_path: Path) -> None:
    start = "(1700000000.0) can0 1A0#0011223344556677\n"
    for last in ("1A0#", "1A0#4E61", "1A0#4E61BC00112233"):
        path = log(tmp_path, f"{start}(1700000000.0) can0 {last}")
        with pytest.raises(
            DescriptionError, match=r"boom\.log:2: the last line has no line end, so its frame may be truncated"
        ):
            list(read_can_log(path))
    for whole in ("1A0#4E61\n", "1A0#4E61\r\n", "1A0#4E61 R", "1A0#0011223344556677", "1A0#R"):
        assert len(list(read_can_log(log(tmp_path, f"{start}(1700000000.0) can0 {whole}")))) == 2, whole


def written_blf(tmp_path: Path) -> Path:
    path = tmp_path / "boom.blf"
    write_can_log(path, CAPTURES)
    return path


def test_a_blf_file_that_was_cut_short_is_refused(tmp_path: Path) -> None:
    path = written_blf(tmp_path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(DescriptionError, match=r"boom\.blf: truncated: it has \d+ bytes, its header \d+"):
        list(read_can_log(path))


@pytest.mark.parametrize("data", [b"", b"LOGG", b"not a blf file" * 20])
def test_what_is_no_blf_file_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "boom.blf"
    path.write_bytes(data)
    with pytest.raises(DescriptionError, match="not a valid BLF file after frame 0"):
        list(read_can_log(path))


def test_a_blf_file_with_more_frames_than_it_says_is_refused(tmp_path: Path) -> None:
    path = written_blf(tmp_path)
    data = bytearray(path.read_bytes())
    struct.pack_into("<L", data, 32, 3)  # object count of the file header
    path.write_bytes(data)
    with pytest.raises(DescriptionError, match="has more frames than the 3 that its header states"):
        list(read_can_log(path))


@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.integers(144, 400), st.integers(1, 255))
def test_a_damaged_blf_file_gives_frames_or_a_reason(tmp_path: Path, position: int, flip: int) -> None:
    path = written_blf(tmp_path)
    data = bytearray(path.read_bytes())
    data[position % len(data)] ^= flip
    path.write_bytes(data)
    try:
        frames = list(read_can_log(path))
    except DescriptionError as error:
        frames = []
        reason = str(error)
    else:
        reason = "boom.blf: no reason"
    assert "boom.blf" in reason
    assert all(len(frame.data) <= 8 for frame in frames)


@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([".log", ".asc"]), st.text(max_size=60))
def test_any_line_is_a_frame_or_a_reason(tmp_path: Path, suffix: str, line: str) -> None:
    path = tmp_path / f"any{suffix}"
    path.write_bytes(line.encode("utf-8", errors="surrogatepass"))
    try:
        frames = list(read_can_log(path))
    except DescriptionError as error:
        frames = []
        reason = str(error)
    else:
        reason = f"any{suffix}: no reason"
    assert f"any{suffix}" in reason
    assert len(frames) <= 1


def test_unknown_suffixes_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"not a known CAN log; its suffix must be one of \.log, \.asc, \.blf"):
        list(read_can_log(tmp_path / "boom.csv"))
    with pytest.raises(DescriptionError, match="not a known CAN log"):
        write_can_log(tmp_path / "boom.csv", [])
    with pytest.raises(DescriptionError, match="cannot be read: No such file"):
        list(read_can_log(tmp_path / "none.log"))
    with pytest.raises(DescriptionError, match="cannot be written: No such file"):
        write_can_log(tmp_path / "none" / "boom.log", [])


def test_a_link_name_that_candump_cannot_hold_is_refused(tmp_path: Path) -> None:
    for name in ("", "my boom"):
        with pytest.raises(DescriptionError, match="cannot be a candump channel"):
            write_can_log(tmp_path / "boom.log", [dataclasses.replace(CAPTURES[0], link=name)])
