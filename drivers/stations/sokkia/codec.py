"""Sokkia SET two-way protocol, also of newer Topcon stations: lines, checksums, records, errors.

    SSSSSSS VVVVVVV HHHHHHH [SUM] CR LF     slope distance in mm, zenith and horizontal angle DDDMMSS

A field that the instrument cannot provide is Exxx. SUM, if the instrument is set to send it, is the sum of all bytes
before it modulo 256 as two upper-case hexadecimal digits; a reply with a wrong SUM is refused. Settings are answered by
a single 06h (done) or 15h (refused). A reply does not contain its units: the instrument must be set to metres, degrees
and zenith angles.
"""

from __future__ import annotations

import re

from drivers.clock import Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Status
from drivers.stations.profile import Codec, ProfileOptions
from drivers.stations.replies import ACK, NAK, Frame, Framer, Garbage, Reply, ReplyKind, instrument_error
from drivers.stations.survey import RecordError, circle_angle_rad, face_of, signed_circle_angle_rad

CR = b"\r"
LF = b"\n"

NO_SUM = (
    "station sends its records without checksums, so a digit changed on the line would go unnoticed: switch Checksum "
    "on in the instrument's communication settings"
)
SUM_AGAIN = "station sends its records with checksums again"
_SUM_CODE, _SUM_AGAIN_CODE = 1, 0  # a warning with a code stands until one with code 0, also when the port is reopened

_SHORTEST_REPLY = 14  # E100 E100 E100
_LINE_LIMIT = 128
_FIELD = rb"(?:\d{7}|E\d{3})"
_REPLY = re.compile(rb"(?:^|(?<=[^0-9A-Za-z ]))" + _FIELD + rb" " + _FIELD + rb" " + _FIELD + rb"(?: [0-9A-F]{2})?\Z")


def checksum(data: bytes) -> bytes:
    """Return the SUM of `data` (including the separator before SUM) as two upper-case hexadecimal digits."""
    return b"%02X" % (sum(data) % 256)


def carries_sum(data: bytes) -> bool:
    """Return True if a valid line (a reply or an identity) ends with a SUM."""
    return data.count(b",") == 4 if data.startswith(b"A ") else data.count(b" ") == 3


def encode_command(command: bytes, crlf: bool) -> bytes:
    """Return `command` as a line, ended by CR LF or by CR."""
    return command + (CR + LF if crlf else CR)


class SetFramer(Framer):
    """Splits a station's bytes into lines and single ACK or NAK characters. Holds at most 128 bytes."""

    def feed(self, data: bytes) -> list[Frame | Garbage]:
        found: list[Frame | Garbage] = []
        for value in data:
            byte = bytes((value,))
            if byte in (CR, LF):
                found += self._line()
                self._start += 1
            elif byte in (ACK, NAK):
                found += self.flush("interrupted by an acknowledgement")
                found.append(Frame(byte, self._start, self._start))
                self._start += 1
            else:
                self._buffer += byte
                if len(self._buffer) == _LINE_LIMIT:
                    found += self.flush(f"no end of line within {_LINE_LIMIT} bytes")
        return found

    def _line(self) -> list[Frame | Garbage]:
        """Return the line that ends here, preceded by any garbage before a reply."""
        line, start = bytes(self._buffer), self._start
        if not line:
            return []
        self._drop(len(line))
        end = start + len(line) - 1
        reply = _REPLY.search(line)
        at = reply.start() if reply else 0
        clutter = [Garbage(line[:at], "garbage before a reply", start, start + at - 1)] if at else []
        return [*clutter, Frame(line[at:], start + at, end)]


def parse_reply(data: bytes, station: str, first_byte: Stamp, last_byte: Stamp) -> Fix:
    """Parse a reply line.

    Args:
        data: the line without its end.
        station: name of the station.
        first_byte: when the line's first byte arrived.
        last_byte: when its last byte arrived.

    Returns:
        A fix; NOT_AVAILABLE, with the instrument's codes in `reason`, if a field is Exxx or the distance is 0.

    Raises:
        RecordError: the line is not a measurement, its SUM is wrong, or an angle is impossible.
    """
    if _REPLY.fullmatch(data) is None:
        raise RecordError(f"expected SSSSSSS VVVVVVV HHHHHHH [SUM], found {data.decode('latin-1')!r}")
    fields = data.decode("ascii").split(" ")
    if len(fields) == 4 and checksum(data[:-2]) != data[-2:]:
        raise RecordError(f"SUM is {fields[3]}, computed {checksum(data[:-2]).decode()}")
    slope, zenith, hz = (None if field.startswith("E") else field for field in fields[:3])
    zenith_rad = None if zenith is None else circle_angle_rad(zenith, "d")
    names = ("slope distance", "zenith angle", "horizontal angle")
    missing = [f"{name}: {field}" for name, field in zip(names, fields[:3], strict=True) if field.startswith("E")]
    if slope is not None and int(slope) == 0:
        missing.append("no distance")
    return Fix(
        station=station,
        stamp=first_byte,
        last_byte=last_byte,
        status=Status.NOT_AVAILABLE if missing else Status.OK,
        lock=LockState.UNKNOWN,
        hz_angle_rad=None if hz is None else signed_circle_angle_rad("+" + hz, "d"),
        zenith_angle_rad=zenith_rad,
        slope_distance_m=int(slope) / 1000 or None if slope is not None else None,
        face=None if zenith_rad is None else face_of(zenith_rad),
        reason=", ".join(missing),
        raw=b" ".join(data.split(b" ")[:3]),
    )


def parse_identity(data: bytes) -> str:
    """Return a description of the instrument from a line `A <name>,<serial>,<ROM>,<EDM>[,SUM]`.

    Raises:
        RecordError: the line has a different form, or its SUM is wrong.
    """
    fields = data.decode("latin-1").removeprefix("A ").split(",")
    if not data.startswith(b"A ") or len(fields) not in (4, 5) or not data.isascii() or not all(fields):
        raise RecordError(f"expected A NAME,SERIAL,ROM,EDM[,SUM], found {data.decode('latin-1')!r}")
    if len(fields) == 5 and checksum(data[:-2]) != data[-2:]:
        raise RecordError(f"SUM is {fields[4]}, computed {checksum(data[:-2]).decode()}")
    return f"{fields[0]}, serial number {fields[1]}, ROM {fields[2]}, EDM {fields[3]}"


def instrument_codes(fix: Fix) -> tuple[int, ...]:
    """Return the Exxx codes of a reply, in the order of its fields."""
    return tuple(int(field[1:]) for field in fix.raw.decode("ascii").split(" ") if field.startswith("E"))


class SetParser:
    """Parser of SET lines (`drivers.stations.replies.Parser`).

    A station without SUM causes one warning, at its first line. After lines with SUM, a single line without SUM is
    refused, because it lost its end on the way; a second one shows that SUM was switched off.

    Args:
        station: name of the station.
        options: not used.
    """

    def __init__(self, station: str, options: ProfileOptions) -> None:  # noqa: ARG002 - every parser gets them
        self._station = station
        self._codes: frozenset[int] = frozenset()
        self._has_sum: bool | None = None  # None: not known yet, or in doubt

    def parse(self, data: bytes, first_byte: Stamp, last_byte: Stamp) -> Reply:
        if data.startswith(b"A "):  # answers the set-up command A
            text = f"station is {parse_identity(data)}"
            identity = DeviceEvent(self._station, first_byte, EventKind.CONFIGURED, text)
            return Reply(ReplyKind.ACK, (*self._watch_sum(data, first_byte), identity))
        fix = parse_reply(data, self._station, first_byte, last_byte)
        codes = frozenset(instrument_codes(fix))
        # It is unknown whether lines with error codes have a SUM; they contain no measured digits that could be altered
        warnings = [] if codes else self._watch_sum(data, first_byte)
        new, self._codes = codes - self._codes, codes
        errors = [
            instrument_error(self._station, first_byte, f"station reports E{code:03d}", code) for code in sorted(new)
        ]
        return Reply(ReplyKind.RECORD, (*warnings, *errors, fix))

    def _watch_sum(self, data: bytes, first_byte: Stamp) -> list[DeviceEvent]:
        """Return a warning at the first valid line without SUM, and its end at the first line with SUM again."""
        had_sum, self._has_sum = self._has_sum, carries_sum(data)
        if self._has_sum and had_sum is False:
            return [DeviceEvent(self._station, first_byte, EventKind.WARNING, SUM_AGAIN, _SUM_AGAIN_CODE)]
        if self._has_sum or had_sum is False:
            return []
        if had_sum:
            self._has_sum = None
            raise RecordError("the line has no SUM, but the previous lines had one")
        return [DeviceEvent(self._station, first_byte, EventKind.WARNING, NO_SUM, _SUM_CODE)]


CODEC = Codec(
    family="sokkia",
    encode=encode_command,
    framer=SetFramer,
    parser=SetParser,
    shortest_record=_SHORTEST_REPLY,
)
