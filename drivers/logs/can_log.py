"""Captured CAN logs: candump `.log`, Vector `.asc` and `.blf`, read and written.

The formats do not keep everything:

* candump: loses the boot that a frame belongs to; instants are kept to the microsecond. Own reader and writer, because
  python-can's turn an error frame into an empty one or, for most error classes, into a data frame that never existed.
* `.blf`: loses link names (channel numbers are kept instead) and which error frames were sent. Own reader
  (`drivers.logs.blf`), because python-can's never ends on some damaged files.
* `.asc`: loses link names, and class and data of error frames; times are local times of the computer that wrote the
  file. Own reader (`drivers.logs.asc`), because python-can's skips damaged lines; python-can's writer is used.

No format keeps a remote frame's length, because a capture has none. CAN FD frames are refused.
"""

from __future__ import annotations

import contextlib
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import can

from drivers.can.frame import DATA_MAX, EXTENDED_ID_MAX, STANDARD_ID_MAX
from drivers.clock import Stamp
from drivers.errors import DescriptionError
from drivers.files import bounded_lines
from drivers.logs.asc import AscReader
from drivers.logs.blf import BlfReader
from drivers.readings import CanCapture

FORMATS = (".log", ".asc", ".blf")

_NS_PER_US = 1000
_LINE_MAX = 10_000
_ERR_FLAG = 0x20000000
_CANDUMP = re.compile(
    r"\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-F]{3}|[0-9A-F]{8})#(?:(R)[0-8]?|((?:[0-9A-F]{2}){0,8}))(?:\s+([RT]))?",
    re.IGNORECASE,
)


def read_can_log(path: Path, link: str | None = None) -> Iterator[CanCapture]:
    """Read a log, frame by frame.

    Stamps have the log's time both as UTC and as monotonic time, and the boot "log".

    Args:
        path: the file; its suffix is one of FORMATS.
        link: link name for all frames; None for the log's own channel names (`can0` for the first channel of an `.asc`
            or `.blf`).

    Raises:
        DescriptionError: not one of FORMATS, cannot be read, or malformed; the message gives the line, or for `.blf`
            the number of the frame. The frames before it have been yielded.
    """
    suffix = _known_suffix(path)
    try:
        if suffix == ".log":
            yield from _read_candump(path, link)
        elif suffix == ".asc":
            yield from _read_asc(path, link)
        else:
            yield from _read_blf(path, link)
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be read: {error.strerror}") from error


def channel_name(number: int) -> str:
    """Return the link name for a channel of an `.asc` or `.blf` log: `can0` for channel 1."""
    return f"can{number - 1}"


def write_can_log(path: Path, captures: Iterable[CanCapture], channels: Mapping[str, int] | None = None) -> int:
    """Write a log; return the number of frames.

    Args:
        path: the file; its suffix is one of FORMATS.
        captures: the frames, in order.
        channels: link -> channel number (from 1) in `.asc` and `.blf`; None to number links in order of appearance.

    Raises:
        DescriptionError: not one of FORMATS, the file cannot be written, or a link's name contains blanks (candump).
    """
    suffix = _known_suffix(path)
    try:
        if suffix == ".log":
            return _write_candump(path, captures)
        return _write_vector(path, captures, channels)
    except OSError as error:
        raise DescriptionError(str(path), f"cannot be written: {error.strerror}") from error


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise DescriptionError(str(path), f"not a known CAN log; its suffix must be one of {', '.join(FORMATS)}")
    return suffix


def _stamp(utc_ns: int, where: str) -> Stamp:
    if not 0 <= utc_ns < 1 << 63:
        raise DescriptionError(where, "the frame's time is before 1970 or after 2262")
    return Stamp(utc_ns, utc_ns, "log")


def _microseconds(capture: CanCapture) -> int:
    return (capture.stamp.utc_ns + _NS_PER_US // 2) // _NS_PER_US


def _read_candump(path: Path, link: str | None) -> Iterator[CanCapture]:
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(bounded_lines(file, _LINE_MAX), 1):
            text = line.strip()
            if text:
                yield _candump_frame(text, link, f"{path}:{number}", is_ended=line.endswith("\n"))


def _candump_frame(text: str, link: str | None, where: str, *, is_ended: bool) -> CanCapture:
    match = _CANDUMP.fullmatch(text)
    if match is None:
        example = "(1700000000.000000) can0 1A0#4E61BC00"
        fd = "CAN FD frames are not supported" if "##" in text else f"not a candump line such as {example}"
        raise DescriptionError(where, f"{fd}: {text[:80]!r}")
    seconds, fraction, channel, identifier, remote, data, direction = match.groups()
    if not is_ended and not direction and data is not None and len(data) < 2 * DATA_MAX:
        raise DescriptionError(
            where,
            f"the last line has no line end, so its frame may be truncated: {text[:80]!r}; "
            "add a line end if the frame is complete, or remove the line",
        )
    arbitration_id = int(identifier, 16)
    is_long = len(identifier) == 8
    is_error = is_long and bool(arbitration_id & _ERR_FLAG)
    arbitration_id &= ~_ERR_FLAG if is_error else 0xFFFFFFFF
    if arbitration_id > (EXTENDED_ID_MAX if is_long else STANDARD_ID_MAX):
        raise DescriptionError(where, f"identifier {identifier} is too large for CAN: {text[:80]!r}")
    return CanCapture(
        channel if link is None else link,
        _stamp(int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")), where),
        arbitration_id,
        bytes.fromhex(data or ""),
        is_extended=is_long and not is_error,
        is_remote=remote is not None,
        is_error=is_error,
        is_transmitted=direction in ("T", "t"),
    )


def _write_candump(path: Path, captures: Iterable[CanCapture]) -> int:
    count = 0
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for capture in captures:
            if not capture.link or any(map(str.isspace, capture.link)):
                raise DescriptionError(
                    str(path),
                    f"link name {capture.link!r} cannot be a candump channel: it is empty or has blanks; rename the "
                    "link, or use .asc or .blf",
                )
            if capture.is_error:
                identifier = f"{_ERR_FLAG | capture.arbitration_id:08X}"
            else:
                identifier = f"{capture.arbitration_id:0{8 if capture.is_extended else 3}X}"
            seconds, microseconds = divmod(_microseconds(capture), 1_000_000)
            data = "R" if capture.is_remote else capture.data.hex().upper()
            direction = "T" if capture.is_transmitted else "R"
            file.write(f"({seconds}.{microseconds:06d}) {capture.link} {identifier}#{data} {direction}\n")
            count += 1
    return count


def _read_asc(path: Path, link: str | None) -> Iterator[CanCapture]:
    with path.open(encoding="cp1252", errors="replace") as file:
        reader = AscReader(bounded_lines(file, _LINE_MAX))
        try:
            for message in reader:
                yield _capture(message, link, f"{path}:{reader.line}")
        except ValueError as error:
            raise DescriptionError(f"{path}:{reader.line}", str(error)) from error


def _read_blf(path: Path, link: str | None) -> Iterator[CanCapture]:
    with path.open("rb") as file:
        number = 0
        try:
            reader = BlfReader(file)
            size = path.stat().st_size
            if size < reader.file_size:
                raise DescriptionError(str(path), f"truncated: it has {size} bytes, its header {reader.file_size}")
            for message in reader:
                number += 1
                if number > reader.object_count > 0:
                    raise DescriptionError(str(path), f"has more frames than the {number - 1} that its header states")
                yield _capture(message, link, f"{path}: frame {number}")
        except (zlib.error, ValueError, ArithmeticError) as error:
            raise DescriptionError(str(path), f"not a valid BLF file after frame {number}: {error}") from error


def _capture(message: can.Message, link: str | None, where: str) -> CanCapture:
    """Convert a python-can message; DescriptionError if it is not a classic CAN frame."""
    data = bytes(message.data)
    if message.is_fd or message.dlc > DATA_MAX:
        raise DescriptionError(where, "CAN FD frames are not supported")
    if not message.is_remote_frame and not message.is_error_frame and len(data) != message.dlc:
        raise DescriptionError(where, f"the frame has {len(data)} bytes, but its length is given as {message.dlc}")
    is_extended = message.is_extended_id and not message.is_error_frame
    if (
        not 0
        <= message.arbitration_id
        <= (EXTENDED_ID_MAX if is_extended or message.is_error_frame else STANDARD_ID_MAX)
    ):
        raise DescriptionError(where, f"identifier {message.arbitration_id:X}h is too large for CAN")
    number = message.channel + 1 if isinstance(message.channel, int) else 1
    return CanCapture(
        channel_name(number) if link is None else link,
        _stamp(round(message.timestamp * 1e6) * _NS_PER_US, where),
        message.arbitration_id,
        data,
        is_extended,
        message.is_remote_frame,
        message.is_error_frame,
        is_transmitted=not message.is_rx,
    )


def _write_vector(path: Path, captures: Iterable[CanCapture], given: Mapping[str, int] | None) -> int:
    seen: dict[str, int] = {}
    count = 0
    writer = can.ASCWriter(path) if path.suffix.lower() == ".asc" else can.BLFWriter(path)
    with contextlib.ExitStack() as stack:
        stack.callback(writer.stop)
        for capture in captures:
            timestamp = _microseconds(capture) / 1e6
            number = seen.setdefault(capture.link, len(seen) + 1) if given is None else given[capture.link]
            if count == 0 and isinstance(writer, can.ASCWriter):
                # Times count from the header's start, whose milliseconds python-can writes without leading zeros
                writer.log_event("// start", math.floor(timestamp))
            writer.on_message_received(
                can.Message(
                    timestamp=timestamp,
                    arbitration_id=capture.arbitration_id,
                    data=capture.data,
                    is_extended_id=capture.is_extended,
                    is_remote_frame=capture.is_remote,
                    is_error_frame=capture.is_error,
                    is_rx=not capture.is_transmitted,
                    channel=number - 1,  # python-can counts from 0
                )
            )
            count += 1
    return count
