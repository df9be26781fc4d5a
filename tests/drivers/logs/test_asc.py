"""Vector's text logs: what real ones hold is read or passed over, what is damaged or cut short is refused."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from drivers.errors import DescriptionError
from drivers.logs.can_log import read_can_log
from drivers.readings import CanCapture

DATE = "date Tue Nov 14 10:13:20.000 pm 2023\n"
BASE = "base hex  timestamps absolute\n"
HEADER = f"{DATE}{BASE}no internal events logged\n"
FRAME = "   0.005000 1  1A0             Rx   d 2 4E 61\n"
START_NS = round(datetime(2023, 11, 14, 22, 13, 20).timestamp()) * 1_000_000_000


def read(tmp_path: Path, text: str) -> list[CanCapture]:
    path = tmp_path / "boom.asc"
    path.write_bytes(text.encode("cp1252"))
    return list(read_can_log(path))


def refused(tmp_path: Path, text: str) -> str:
    """What is said of a log, from its file's name on."""
    with pytest.raises(DescriptionError) as caught:
        read(tmp_path, text)
    return str(caught.value).removeprefix(f"{tmp_path}/")


def test_frames_of_every_kind_are_read(tmp_path: Path) -> None:
    frames = read(
        tmp_path,
        HEADER
        + "   0.010000 1  1A0             Rx   d 4 4E 61 BC 00  Length = 0 BitCount = 0 ID = 416\n"
        + "   0.020000 2  CFE3021x        Tx   d 1 7D\n"
        + "   0.025000 1  80              Rx   d 0 \n"
        + "   0.030000 1  3FF             Tx   d D 55 AA 01 02 03 04 05 06  Length = 232016 BitCount = 119 ID = 1023\n"
        + "   2.510001 2 100 Rx r\n"
        + "   2.520002 3 200 Tx r 8 Length = 1704000 BitCount = 145 ID = 88888888x\n"
        + "   4.501000 2 ErrorFrame Flags = 0xe CodeExt = 0x20a2 Code = 0x82 ID = 0 DLC = 0 Position = 5\n",
    )
    assert [(c.link, c.arbitration_id, c.data, c.is_extended, c.is_transmitted) for c in frames] == [
        ("can0", 0x1A0, bytes.fromhex("4E61BC00"), False, False),
        ("can1", 0x0CFE3021, b"\x7d", True, True),
        ("can0", 0x080, b"", False, False),
        ("can0", 0x3FF, bytes.fromhex("55AA010203040506"), False, True),  # a classic frame has 8 bytes whatever above 8
        ("can1", 0x100, b"", False, False),
        ("can2", 0x200, b"", False, True),
        ("can1", 0, b"", False, False),
    ]
    assert [c.is_remote for c in frames] == [False] * 4 + [True, True, False]
    assert [c.is_error for c in frames] == [False] * 6 + [True]
    assert frames[0].stamp.utc_ns == START_NS + 10_000_000


@pytest.mark.parametrize(
    "line",
    [
        "",
        "// version 9.0.0",
        ";  time  can ident        attr dlc data ...Wed Jun 5 03:18:58 pm 2002",
        "Begin Triggerblock",
        "Begin TriggerBlock Tue Nov 14 22:13:20.000 2023",
        "End TriggerBlock",
        "internal events logged",
        "0.000000 Start of measurement",
        "0.000000 // start",
        "0.015991 CAN 1 Status:chip status error passive - TxErr: 132 RxErr: 0",
        "1.015991 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%",
        "3.297743 1  J1939TP FEE3p        6    0  0   -   Rx   d 23 A0 0F A6 60 3B D1 40",
        "3.4 2 OverloadFrame",
        "3.5 1  1A0             TxRq d 2 00 00",
        "3.6 log trigger event",
        "3.6 log direct start (0ms)",
        "3.7 Li 2d              Rx     8 00 f0 f0 ff ff ff 00 00  checksum = 70",
        "3.8 ETH 1 Rx  0:",
        "3.9 EnvTemperature := 21",
        "4.0 SV: 1 0 1 ::Rig::Pressure = 12.5",
        "4.1 GPS device: 1 La:48.8 Lo: 9.1",
        "4.2 CAN 1 Boom::Angles::theta1 = 12",
    ],
)
def test_what_else_a_log_tells_is_passed_over(tmp_path: Path, line: str) -> None:
    assert len(read(tmp_path, f"{HEADER}{FRAME}{line}\n{FRAME}")) == 2


def test_numbers_are_read_in_the_base_of_the_header(tmp_path: Path) -> None:
    (frame,) = read(tmp_path, DATE + "base dec  timestamps absolute\n0.1 1  416  Rx  d 3 255 7 012\n")
    assert (frame.arbitration_id, frame.data) == (416, bytes([255, 7, 12]))
    text = refused(tmp_path, DATE + "base dec  timestamps absolute\n0.1 1  1A0  Rx  d 1 0\n")
    assert text == "boom.asc:3: identifier '1A0' is not a decimal number: '0.1 1  1A0  Rx  d 1 0'"
    assert "has 0 bytes, but its length is given as 1" in refused(
        tmp_path, DATE + "base dec\n0.1 1  416  Rx  d 1 256\n"
    )


@pytest.mark.parametrize(
    "date",
    [
        "Tue Nov 14 10:13:20.000 pm 2023",
        "Tue Nov 14 22:13:20 2023",
        "Di Nov 14 10:13:20.0 PM 2023",
        "Nov 14 22:13:20.000000 2023",
    ],
)
def test_dates_are_read_as_tools_write_them(tmp_path: Path, date: str) -> None:
    (frame,) = read(tmp_path, f"date {date}\n{BASE}{FRAME}")
    assert frame.stamp.utc_ns == START_NS + 5_000_000


@pytest.mark.parametrize(
    ("english", "german"), [("Wed Mar 1", "Mi M\u00e4r 1"), ("Mon May 1", "Mo Mai 1"), ("Sun Dec 31", "So Dez 31")]
)
def test_months_are_read_in_german_as_well(tmp_path: Path, english: str, german: str) -> None:
    found = [read(tmp_path, f"date {day} 12:00:00.000 2023\n{BASE}{FRAME}")[0].stamp for day in (english, german)]
    assert found[0] == found[1]


@pytest.mark.parametrize(
    "date",
    ["Smarch 14 2023", "Feb 30 12:00:00 2023", "Nov 14 13:00:00 pm 2023", "Nov 14 24:00:00 2023", "Nov 14 12:00:00"],
)
def test_a_date_that_is_none_is_refused(tmp_path: Path, date: str) -> None:
    for line in (f"date Tue {date}", f"Begin Triggerblock Tue {date}"):
        text = refused(tmp_path, f"{HEADER}{line}\n{FRAME}")
        assert text == f"boom.asc:4: not a date such as Fri Nov 27 11:48:03.730 2026: 'Tue {date}'"


def test_a_trigger_block_says_when_its_frames_were(tmp_path: Path) -> None:
    frames = read(
        tmp_path,
        f"{BASE}Begin Triggerblock {DATE[5:]}{FRAME}Begin Triggerblock Tue Nov 14 10:13:30.000 pm 2023\n{FRAME}",
    )
    assert [c.stamp.utc_ns - START_NS for c in frames] == [5_000_000, 10_005_000_000]


def test_the_first_line_after_a_short_header_is_a_frame_as_well(tmp_path: Path) -> None:
    assert len(read(tmp_path, DATE + BASE + FRAME + FRAME)) == 2


def test_a_log_whose_header_is_missing_is_refused_as_its_times_and_numbers_would_be_guessed(tmp_path: Path) -> None:
    for text in (FRAME, DATE + FRAME):
        assert "there is no line 'base hex' or 'base dec' before this frame" in refused(tmp_path, text)
    text = refused(tmp_path, BASE + FRAME)
    assert text.startswith("boom.asc:2: there is no line 'date ...' or 'Begin Triggerblock ...' before this frame")
    assert "'date ...'" in refused(tmp_path, BASE + "0.1 1  ErrorFrame\n")


def test_times_that_count_from_line_to_line_are_refused(tmp_path: Path) -> None:
    text = refused(tmp_path, DATE + "base hex  timestamps relative\n" + FRAME)
    assert text == "boom.asc:2: relative timestamps are not supported; save the log with absolute timestamps"


@pytest.mark.parametrize(
    "line",
    [
        "garbage here",
        "12.5",
        "0.010000 1",
        "0.010000 1  723",
        "0.010000 1  723             Rx   d",
        "0.010000 1  1A0             Qx   d 1 4E",
        "0.0100001  1A0             Rx   d 1 4E",
        "0.010000 1  ErrorFra",
        "0.010000 Start of measure",
        "End Trigger",
        "date",
        "9" * 400 + ".0 1  1A0       Rx   d 1 00",
    ],
)
def test_a_line_that_is_no_frame_and_not_known_is_refused(tmp_path: Path, line: str) -> None:
    text = refused(tmp_path, f"{HEADER}{FRAME}{line}\n{FRAME}")
    assert text.startswith(
        f"boom.asc:5: not a line of an ASC log such as 0.057767 1  1BC  Rx  d 2 0B 05: '{line[:80]}'; "
    )


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("0.010000 1  1G0             Rx   d 1 4E", "identifier '1G0' is not a hexadecimal number: '0.010000 1  1G0 "),
        ("0.010000 1  1A0             Rx   d 8 4E 61", "the frame has 2 bytes, but its length is given as 8: "),
        ("0.010000 1  1A0             Rx   d 2 4E 61 00", "the frame has 3 bytes, but its length is given as 2: "),
        ("0.010000 1  1A0             Rx   d 1 XX", "the frame has 0 bytes, but its length is given as 1: "),
        ("0.010000 1  1A0             Rx   d 1 4", "the frame has 0 bytes, but its length is given as 1: "),
        ("0.010000 1  1A0             Rx   d 10 4E", "10 is not a valid frame length: "),
        ("0.010000 1  1A0             Rx   d Z 4E", "length 'Z' is not a hexadecimal number: "),
        ("9" * 12 + ".0 1  1A0       Rx   d 1 00", "the frame's time is before 1970 or after 2262"),
        ("0.010000 1  8FF             Rx   d 1 4E", "identifier 8FFh is too large"),
        ("0.010000 1  2FFFFFFFx       Rx   d 1 4E", "identifier 2FFFFFFFh is too large"),
        ("0.010000 CANFD 1 Rx 1A0 1 0 d 32 " + "00 " * 32 + "0 0 3000 0 0 0 0 0", "CAN FD frames are not supported"),
    ],
)
def test_a_malformed_frame_is_refused_with_its_line(tmp_path: Path, line: str, reason: str) -> None:
    assert refused(tmp_path, f"{HEADER}{FRAME}{line}\n{FRAME}").startswith(f"boom.asc:5: {reason}")


def test_a_log_is_refused_wherever_its_last_frame_is_cut(tmp_path: Path) -> None:
    whole = len(FRAME.rstrip())
    for end in range(FRAME.index("0.005") + 1, whole):
        assert refused(tmp_path, HEADER + FRAME + FRAME[:end]).startswith("boom.asc:5: "), FRAME[:end]
    assert len(read(tmp_path, HEADER + FRAME + FRAME[:whole])) == 2
    decimal = DATE + "base dec\n0.1 1  416  Rx  d 1 25"  # of 255?
    assert "the last line has no line end, so its last number may be truncated" in refused(tmp_path, decimal)


def test_frames_before_a_damaged_line_are_given(tmp_path: Path) -> None:
    path = tmp_path / "boom.asc"
    path.write_text(HEADER + FRAME + "garbage here\n", encoding="ascii")
    frames = read_can_log(path)
    assert next(frames).data == b"\x4e\x61"
    with pytest.raises(DescriptionError, match=r"boom\.asc:5: "):
        next(frames)
