"""Files that made their readers go on for ever, take gigabytes, or end in a traceback: each is one sentence."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from pathlib import Path

import can
import pytest

from drivers.can.dbc import DbcFile
from drivers.canopen.pdo import TransmitPdo
from drivers.errors import DescriptionError
from drivers.logs.blf import BlfReader
from drivers.logs.can_log import read_can_log, write_can_log
from drivers.logs.serial_log import read_serial_log
from drivers.readings import CanCapture
from tests.drivers.can_support import DBC, EDS, capture

CORPUS = Path(__file__).parents[2] / "fuzz" / "corpus"
CAPTURES = [
    capture("1A0 00 40 00 00"),
    capture("0CFE3021 7D FF 71", 0.5),
    dataclasses.replace(capture("20000004 00 04", 1.0), is_error=True, is_extended=False, arbitration_id=4),
    capture("1A1", 1.5, is_remote=True),
]
HEADER_BYTES = 144
DATE = (2023, 11, 2, 14, 22, 13, 20, 0)


def blf(tmp_path: Path, objects: bytes, is_packed: bool = True) -> Path:
    """A log with these objects in one container."""
    content = struct.pack("<H6xL4x", 2 if is_packed else 0, len(objects))
    content += zlib.compress(objects) if is_packed else objects
    return blf_with(tmp_path, struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(content), 10) + content)


def blf_with(tmp_path: Path, rest: bytes, date: tuple[int, ...] = DATE) -> Path:
    """A log whose header counts nothing, and what follows it."""
    head = struct.pack("<4sLBBBBBBBBQQLL8H8H", b"LOGG", HEADER_BYTES, *[0] * 8, 0, 0, 0, 0, *date * 2)
    path = tmp_path / "hostile.blf"
    path.write_bytes(head.ljust(HEADER_BYTES, b"\0") + rest)
    return path


def refused(path: Path, reason: str) -> None:
    with pytest.raises(DescriptionError, match=reason) as caught:
        list(read_can_log(path))
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("size", [0, 1, 15])
def test_a_blf_object_smaller_than_its_header_is_refused_and_not_read_for_ever(tmp_path: Path, size: int) -> None:
    refused(
        blf(tmp_path, struct.pack("<4sHHLL", b"LOBJ", 16, 9, size, 65).ljust(64, b"\0")), f"an object has {size} bytes"
    )
    refused(blf_with(tmp_path, struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10)), f"an object has {size} bytes")


def test_a_blf_object_larger_than_any_is_refused_before_it_is_read(tmp_path: Path) -> None:
    refused(blf_with(tmp_path, struct.pack("<4sHHLL", b"LOBJ", 16, 1, 2**32 - 1, 10)), "an object has 4294967295 bytes")


def test_a_blf_container_that_unpacks_to_hundreds_of_times_its_size_is_refused(tmp_path: Path) -> None:
    refused(blf(tmp_path, bytes(8 << 20)), "bytes unpack to more than")


@pytest.mark.parametrize(
    ("rest", "reason"),
    [
        (b"LOBX" + bytes(12), "no object found where one should begin"),
        (struct.pack("<4sHHLL", b"LOBJ", 16, 1, 60, 10), "the file ends before"),
        (struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32, 10, 7, 0), "unknown compression method 7"),
        (struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 36, 10, 2, 0) + b"junk", "not a valid BLF file after frame 0"),
        (struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 34, 10, 2, 9) + zlib.compress(b"a")[:2], "is truncated"),
        (struct.pack("<4sHHLLH", b"LOBJ", 16, 1, 18, 10, 2), "a container has no header"),
        (struct.pack("<4sHHLL", b"LOBJ", 32, 9, 48, 1) + bytes(32), "a header of unknown version 9"),
        (struct.pack("<4sHHLL", b"LOBJ", 32, 1, 36, 1) + bytes(20), "a frame is truncated"),
    ],
)
def test_a_damaged_blf_object_is_refused_with_its_place(tmp_path: Path, rest: bytes, reason: str) -> None:
    refused(blf_with(tmp_path, rest), reason)


@pytest.mark.parametrize("name", ["written", "classic-in-fd-objects", "golden"])
def test_a_blf_file_reads_as_with_python_can(tmp_path: Path, name: str) -> None:
    if name == "golden":
        path = Path(__file__).parents[2] / "golden" / "simulated" / "standing" / "boom.blf"
    else:
        path = tmp_path / "log.blf"
        path.write_bytes((CORPUS / "log-blf" / f"seed-{name}").read_bytes())
    with can.BLFReader(path) as theirs, path.open("rb") as file:
        expected = [dataclasses.astuple(_plain(message)) for message in theirs]
        assert [dataclasses.astuple(_plain(message)) for message in BlfReader(file)] == expected
    assert expected


@dataclasses.dataclass(frozen=True)
class _Plain:
    """Return the parts of python-can's message that a capture has."""

    microseconds: int
    identifier: int
    data: bytes
    length: int
    flags: tuple[bool, ...]
    channel: object


def _plain(message: can.Message) -> _Plain:
    flags = (message.is_extended_id, message.is_remote_frame, message.is_error_frame, message.is_rx, message.is_fd)
    microseconds = round(message.timestamp * 1e6)
    return _Plain(microseconds, message.arbitration_id, bytes(message.data), message.dlc, flags, message.channel)


def test_an_object_may_begin_in_one_container_and_end_in_the_next(tmp_path: Path) -> None:
    path = tmp_path / "boom.blf"
    write_can_log(path, CAPTURES)
    data = path.read_bytes()
    size = struct.unpack_from("<L", data, HEADER_BYTES + 8)[0]
    objects = zlib.decompress(data[HEADER_BYTES + 32 : HEADER_BYTES + size])
    halves = [blf(tmp_path, half, is_packed=False).read_bytes()[HEADER_BYTES:] for half in (objects[:50], objects[50:])]
    padded = [half + bytes(len(half) % 4) for half in halves]
    path.write_bytes(data[:HEADER_BYTES] + b"".join(padded))
    head = bytearray(path.read_bytes())
    struct.pack_into("<Q", head, 16, len(head))
    path.write_bytes(head)
    found: list[CanCapture] = list(read_can_log(path))
    assert [c.data for c in found] == [c.data for c in CAPTURES]


def test_a_blf_file_without_a_date_is_refused_as_its_frames_would_be_of_1970(tmp_path: Path) -> None:
    path = tmp_path / "boom.blf"
    write_can_log(path, CAPTURES)
    refused(blf_with(tmp_path, path.read_bytes()[HEADER_BYTES:], (0,) * 8), "its header has no valid date")


@pytest.mark.parametrize("suffix", [".log", ".asc"])
def test_a_line_without_an_end_is_refused_before_it_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"boom{suffix}"
    path.write_bytes(b"date Sat Sep 30 15:06:13.191 2017\nbase hex\n" * (suffix == ".asc") + b"1" * 100_000)
    with pytest.raises(DescriptionError, match=r"longer than"):
        list(read_can_log(path))


def test_a_capture_without_an_end_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "station.serial"
    path.write_bytes(b"rigcal-serial-capture 1\nlink s\nbaud 9600\nprofile p\nboot b\n" + b"1" * (2 << 20))
    with pytest.raises(DescriptionError, match="line 6 is longer than"):
        list(read_serial_log(path))


# ---- DBC -------------------------------------------------------------------------------------------------------------


def dbc(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "hostile.dbc"
    path.write_text("\n".join(['VERSION ""', "NS_ :", "BS_:", "BU_: A", *lines, ""]), encoding="cp1252")
    return path


def signal(name: str, mux: str = "", start: int = 0, bits: int = 8) -> str:
    return f' SG_ {name} {mux}: {start}|{bits}@1+ (1,0) [0|0] "" A'


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (["BO_ 512 X: 16000 A", signal("S")], "message 'X' has 16000 bytes; the longest has 1785"),
        (["BO_ 512 X: -65 A", signal("S")], "message 'X' has -65 bytes"),
        (["BO_ 512 X: 99999999999999 A"], "message 'X' has 99999999999999 bytes"),
        (
            ["BO_ 512 X: 8 A", signal("M", "M "), signal("S", "m0 ", 8), "SG_MUL_VAL_ 512 S M 0-4294967295;"],
            "signal 'S': its multiplexers",
        ),
        (
            ["BO_ 512 X: 8 A", signal("M", "M "), signal("S", "m0 ", 8), "SG_MUL_VAL_ 512 S M 0-40000;"],
            "signal 'S': its multiplexers",
        ),
        (
            ["BO_ 512 X: 8 A", signal("M", "M "), signal("S", "m0 ", 8), "SG_MUL_VAL_ -8 S M -16777216-0;"],
            "signal 'S': its multiplexers",
        ),
        (
            ["BO_ 512 X: 8 A", signal("M", "M "), signal("S", "m0 ", 8), "SG_MUL_VAL_ 512 S M -167772+0;"],
            "signal 'S': its multiplexers",
        ),
        (
            ["BO_ 512 X: 8 A", signal("M", "M "), signal("S", "m0 ", 8), "SG_MUL_VAL_ // 512", "512S M 0-167772;"],
            "signal 'S': its multiplexers",
        ),
        (
            [
                "SG_MUL_VAL_ 512 M1 M0 0-99;",
                "SG_MUL_VAL_ 512 M2 M1 0-99;",
                "SG_MUL_VAL_ 512 M3 M2 0-99;",
                *("BO_ 512 X: 8 A", signal("M0", "M "), signal("M1", "m0M ", 8), signal("M2", "m0M ", 16)),
                signal("M3", "m0M ", 24),
            ],
            "its multiplexers",
        ),
        (["BO_ 512 X: 8 A", signal("S", start=10**9)], "signal 'S' does not fit"),
        (["BO_ 512 X: 8 A", signal("S", bits=10**9)], "signal 'S' does not fit"),
        (
            ["BO_ 512 X: 8 A", 'BA_DEF_ "a" INT 0 1;', 'BA_DEF_DEF_ "a" 0;', 'BA_ "a" 1e999999999;'],
            "1e999999999 is too large",
        ),
        (["BO_ 512 X: 1785 A", *(signal(f"S{i}", start=8 * i) for i in range(400))], "too large to be read in time"),
        (
            ["BO_ 512 X: 1785 A", *(signal(f"S{i}") for i in range(400)), "BO_ 512 Y: 8 A"],
            "too large to be read in time",
        ),
        (["BO_ 512 X: 1785 A", *(signal(f"S{i}", start=-1) for i in range(400))], "too large to be read in time"),
        ([f"BO_ {2**31 + i} X{i}: 8 A" for i in range(10_001)], "too large to be read in time"),
        (["BU_: " + "A " * 10_001], "too large to be read in time"),
        (["A " * 400_001], "too large to be read in time"),
        (["A" * (3 << 20)], "cannot be read: it is larger than the limit of 2,097,152 bytes"),
    ],
)
def test_a_dbc_file_that_would_take_minutes_and_gigabytes_is_refused(
    tmp_path: Path, lines: list[str], reason: str
) -> None:
    path = dbc(tmp_path, *lines)
    with pytest.raises(DescriptionError, match=reason) as caught:
        DbcFile(path)
    assert str(caught.value).startswith(str(path))


def test_what_strings_of_a_dbc_file_say_of_sizes_is_no_size(tmp_path: Path) -> None:
    file = DbcFile(dbc(tmp_path, "BO_ 512 X: 8 A", signal("S"), 'CM_ "BO_ 512 X: 16000 \\" 1e99999";'))
    assert file.channel("s", "x", "X", "S").arbitration_id == 512


def test_the_longest_message_of_j1939_may_stand_beside_others(tmp_path: Path) -> None:
    file = DbcFile(dbc(tmp_path, "BO_ 2147483648 Long: 1785 A", signal("L", bits=64), "BO_ 512 X: 8 A", signal("S")))
    assert file.channel("s", "x", "X", "S").arbitration_id == 512


@pytest.mark.parametrize(
    ("old", "new"),
    [(": 0|16@", ": -16|16@"), ("(0.1,0)", f"(0.1,{10**400})"), ("[0|600]", f"[0|{10**400}]")],
)
def test_a_signal_that_no_number_can_hold_is_refused_by_name(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "machine.dbc"
    before, line, after = DBC.read_text(encoding="cp1252").partition("SG_ P_Pump_bar")
    assert old in after
    path.write_text(before + line + after.replace(old, new, 1), encoding="cp1252")
    with pytest.raises(DescriptionError, match="signal 'P_Pump_bar' cannot be read"):
        DbcFile(path).channel("pump", "bar", "Pressure1", "P_Pump_bar")


# ---- EDS -------------------------------------------------------------------------------------------------------------


def test_an_eds_file_larger_than_any_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "device.eds"
    path.write_bytes(EDS.read_bytes() + b"\n;" + b" " * (2 << 20))
    with pytest.raises(DescriptionError, match=r"cannot be read: it is larger than the limit of 2,097,152 bytes"):
        TransmitPdo.from_eds(path, 32, 1)


def test_an_eds_file_with_a_long_run_of_blanks_does_not_hang(tmp_path: Path) -> None:
    path = tmp_path / "device.eds"
    path.write_bytes(b"[DeviceInfo]\na" + b" " * (1 << 20) + b"b\n" + b"\t \x0b" * 1000 + b"c\n")
    with pytest.raises(DescriptionError, match="not a valid EDS"):
        TransmitPdo.from_eds(path, 32, 1)


@pytest.mark.parametrize("line", ["a", " a", "=1", "[a"])
def test_an_eds_file_of_many_bad_lines_is_refused_at_the_first(tmp_path: Path, line: str) -> None:
    path = tmp_path / "bad.eds"
    path.write_text("[DeviceInfo]\n" + f"{line}\n" * 300_000)  # an hour, if all were collected
    with pytest.raises(DescriptionError, match=r"line 2 is neither \[section\] nor name=value"):
        TransmitPdo.from_eds(path, 32, 1)


def test_an_eds_file_is_never_read_as_xml_whatever_it_is_called(tmp_path: Path) -> None:
    path = tmp_path / "device.epf"
    path.write_bytes(b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><a>&b;</a>')
    with pytest.raises(DescriptionError, match="no section headers"):
        TransmitPdo.from_eds(path, 32, 1)


def test_a_message_that_quotes_a_whole_file_is_cut(tmp_path: Path) -> None:
    path = tmp_path / "device.eds"
    path.write_text("no section " * 1000, encoding="latin-1")
    with pytest.raises(DescriptionError, match=r"no section headers.*\.\.\.$") as caught:
        TransmitPdo.from_eds(path, 32, 1)
    assert len(str(caught.value)) < 1100
