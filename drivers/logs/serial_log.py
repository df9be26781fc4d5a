"""Captured serial links as text files with one capture per line, similar to candump's logs for CAN.

    rigcal-serial-capture 1
    link station
    baud 9600
    profile topcon_gts8
    boot 5f0c9d5e-7c9b-4c0e-8c65-0a4b8f2e9d11
    1700000000.123456789 1000000000 rx 5130303630330d0a
    1700000000.223456789 1100000000 tx 4331313036370d0a

A capture line has UTC in seconds with nine decimals, the monotonic clock in ns, the direction, and the bytes in
hexadecimal. A `boot` line gives the boot that the monotonic clock of the following lines belongs to. Lines that begin
with `#` are comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from drivers.clock import NS_PER_S, Stamp
from drivers.errors import DescriptionError
from drivers.files import bounded_lines
from drivers.readings import SerialCapture

_FIRST_LINE = "rigcal-serial-capture 1"
_HEADER_KEYS = ("link", "baud", "profile")
_CAPTURE = re.compile(
    r"(?P<utc_s>\d{1,10})\.(?P<utc_ns>\d{9}) (?P<monotonic_ns>\d{1,18}) "
    r"(?P<direction>rx|tx) (?P<data>(?:[0-9a-f]{2})+)",
    re.ASCII,
)


@dataclass(frozen=True, slots=True)
class SerialLogHeader:
    """Header of a capture file.

    Attributes:
        link: name of the link.
        baud: baud rate in bit/s.
        profile: profile of the station (`drivers.stations.profiles`).
    """

    link: str
    baud: int
    profile: str


class SerialLogWriter:
    """Writes captures of one link to a text stream.

    Args:
        stream: text stream open for writing in UTF-8, with line feeds as line ends; the caller closes it.
        header: description of the link.
    """

    def __init__(self, stream: TextIO, header: SerialLogHeader) -> None:
        self._stream = stream
        self._boot_id: str | None = None
        stream.write(f"{_FIRST_LINE}\nlink {header.link}\nbaud {header.baud}\nprofile {header.profile}\n")

    def write(self, capture: SerialCapture) -> None:
        """Append one capture."""
        stamp = capture.stamp
        if stamp.boot_id != self._boot_id:
            self._boot_id = stamp.boot_id
            self._stream.write(f"boot {stamp.boot_id}\n")
        seconds, nanoseconds = divmod(stamp.utc_ns, NS_PER_S)
        direction = "tx" if capture.is_transmitted else "rx"
        self._stream.write(f"{seconds}.{nanoseconds:09d} {stamp.monotonic_ns} {direction} {capture.data.hex()}\n")


def read_serial_log(path: Path) -> Iterator[SerialCapture]:
    """Yield the captures of a file in order.

    Raises:
        DescriptionError: the file cannot be read, is not a serial capture, or has a malformed line; the message names
            file and line.
    """
    lines = _lines(path)
    link = _header(path, lines).link
    boot_id: str | None = None
    for number, line in lines:
        key, _, value = line.partition(" ")
        if key == "boot":
            boot_id = value
            continue
        match = _CAPTURE.fullmatch(line)
        if match is None:
            raise DescriptionError(
                f"{path}, line {number}",
                "expected SECONDS.NANOSECONDS MONOTONIC_NS rx|tx HEXBYTES, or boot ID; "
                "the line is damaged or the file is truncated",
            )
        if boot_id is None:
            raise DescriptionError(f"{path}, line {number}", "expected a line 'boot ID' before the first capture")
        utc_ns = int(match["utc_s"]) * NS_PER_S + int(match["utc_ns"])
        stamp = Stamp(utc_ns, int(match["monotonic_ns"]), boot_id)
        yield SerialCapture(link, stamp, bytes.fromhex(match["data"]), match["direction"] == "tx")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines with their numbers, without comments and empty lines."""
    try:
        with path.open("rb") as stream:
            for number, line in enumerate(bounded_lines(stream), 1):
                text = line.rstrip(b"\r\n")
                if text == line:
                    raise DescriptionError(f"{path}, line {number}", "the line has no line end: the file is truncated")
                if text and not text.startswith(b"#"):
                    yield number, _text(path, number, text)
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error


def _text(path: Path, number: int, line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path}, line {number}", "is not UTF-8 text: the file is damaged") from error


def _header(path: Path, lines: Iterator[tuple[int, str]]) -> SerialLogHeader:
    number, line = next(lines, (1, ""))
    if line != _FIRST_LINE:
        raise DescriptionError(f"{path}, line {number}", f"expected {_FIRST_LINE!r}: this is not a serial capture file")
    values: dict[str, str] = {}
    for expected in _HEADER_KEYS:
        number, line = next(lines, (number + 1, ""))
        key, _, values[expected] = line.partition(" ")
        if key != expected or not values[expected]:
            raise DescriptionError(f"{path}, line {number}", f"expected '{expected} ...', found {line!r}")
        if key == "baud" and not re.fullmatch(r"[1-9]\d{0,8}", values[key], re.ASCII):
            raise DescriptionError(f"{path}, line {number}", f"baud {values[key]!r} is not a positive whole number")
    return SerialLogHeader(values["link"], int(values["baud"]), values["profile"])
