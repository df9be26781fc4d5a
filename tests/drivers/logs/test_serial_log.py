from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.logs.serial_log import SerialLogHeader, SerialLogWriter, read_serial_log
from drivers.readings import SerialCapture

HEADER = SerialLogHeader("station", 9600, "topcon_gts8")
TEXT = """rigcal-serial-capture 1
link station
baud 9600
profile topcon_gts8
# a comment

boot first
1700000000.123456789 1000000000 rx 5130
1700000000.223456789 1100000000 tx 4331
"""


def written(path: Path, captures: list[SerialCapture]) -> Path:
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        writer = SerialLogWriter(stream, HEADER)
        for capture in captures:
            writer.write(capture)
    return path


def test_a_file_reads_as_its_captures(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text(TEXT, encoding="utf-8")
    assert list(read_serial_log(path)) == [
        SerialCapture("station", Stamp(1_700_000_000_123_456_789, 1_000_000_000, "first"), b"Q0"),
        SerialCapture("station", Stamp(1_700_000_000_223_456_789, 1_100_000_000, "first"), b"C1", is_transmitted=True),
    ]


@given(
    st.lists(
        st.builds(
            SerialCapture,
            st.just("station"),
            st.builds(Stamp, st.integers(0, 2**62), st.integers(0, 2**59), st.sampled_from(["one", "two", ""])),
            st.binary(min_size=1, max_size=300),
            st.booleans(),
        ),
        max_size=8,
    )
)
def test_what_is_written_is_read_again(tmp_path_factory: pytest.TempPathFactory, captures: list[SerialCapture]) -> None:
    path = written(tmp_path_factory.mktemp("log") / "log", captures)
    assert list(read_serial_log(path)) == captures


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("rigcal-serial-capture 1", "rigcal-serial-capture 2", 1, "not a serial capture file"),
        ("baud 9600", "speed 9600", 3, "expected 'baud"),
        ("baud 9600", "baud fast", 3, "not a positive whole number"),
        ("baud 9600", "baud 0", 3, "not a positive whole number"),
        ("link station", "link ", 2, "expected 'link"),
        ("rx 5130", "rx 513", 8, "damaged or the file is truncated"),
        ("rx 5130", "rx", 8, "damaged"),
        ("rx 5130", "up 5130", 8, "damaged"),
        ("rx 5130", "rx 51ZZ", 8, "damaged"),
        ("1700000000.123456789", "1700000000.1", 8, "damaged"),
        ("1700000000.123456789", "-1.123456789", 8, "damaged"),
        ("boot first\n", "", 7, "expected a line 'boot ID'"),
    ],
)
def test_a_malformed_line_is_refused_with_file_and_line(
    tmp_path: Path, old: str, new: str, line: int, reason: str
) -> None:
    path = tmp_path / "log"
    path.write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(DescriptionError, match=rf"log, line {line}: .*{reason}"):
        list(read_serial_log(path))


def test_a_log_is_refused_wherever_its_last_capture_is_cut(tmp_path: Path) -> None:
    path = tmp_path / "log"
    for end in range(TEXT.rindex("17") + 1, len(TEXT)):
        path.write_text(TEXT[:end], encoding="utf-8")
        with pytest.raises(DescriptionError, match=r"log, line 9: the line has no line end: the file is truncated"):
            list(read_serial_log(path))


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("", encoding="utf-8")
    with pytest.raises(DescriptionError, match=r"line 1: .*not a serial capture file"):
        list(read_serial_log(path))


def test_bytes_that_are_no_text_are_refused_with_their_line(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(TEXT.encode() + b"\xff\xfe\n")
    with pytest.raises(DescriptionError, match=r"log, line 10: is not UTF-8"):
        list(read_serial_log(path))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match="absent: cannot be read: No such file"):
        list(read_serial_log(tmp_path / "absent"))


@given(st.binary(max_size=200))
def test_arbitrary_bytes_after_a_header_read_or_are_refused(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("log") / "log"
    path.write_bytes(TEXT.encode() + data)
    try:
        captures = list(read_serial_log(path))
    except DescriptionError:
        return
    assert len(captures) >= 2
    assert all(capture.data for capture in captures)
