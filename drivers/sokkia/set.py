"""Replies of the Sokkia SET protocol.

    SSSSSSS VVVVVVV HHHHHHH [SUM] CR LF     slope distance in mm, zenith and horizontal angle DDDMMSS

A field that the instrument cannot give reads Exxx. SUM, if the instrument is set to send it, is the sum of all bytes
before it modulo 256 as two upper-case hexadecimal digits; a reply that carries one must have the right one. Settings
are answered by a single 06h (done) or 15h (refused). The reply does not name its units: the instrument must be set to
metres, degrees, and zenith angles.
"""

from __future__ import annotations

import re

from drivers.bytestream import Frame, Garbage
from drivers.clock import Stamp
from drivers.readings import Fix, LockState, Status
from drivers.survey import RecordError, circle_angle_rad, face_of, signed_circle_angle_rad

ACK = b"\x06"
NAK = b"\x15"
CR = b"\r"
LF = b"\n"

# 11H and 12H in the manuals: hexadecimal codes of single characters, as 06H (ACK) and 0DH (CR) are there.
REQUEST_DISTANCE = b"\x11"
STOP = b"\x12"
TRACKING = b"Xe"

_LINE_LIMIT = 128
_FIELD = rb"(?:\d{7}|E\d{3})"
_REPLY = re.compile(rb"(?:^|(?<=[^0-9A-Za-z ]))" + _FIELD + rb" " + _FIELD + rb" " + _FIELD + rb"(?: [0-9A-F]{2})?\Z")


def checksum(data: bytes) -> bytes:
    """SUM of `data`, which ends with the separator before it: two upper-case hexadecimal digits."""
    return b"%02X" % (sum(data) % 256)


def carries_sum(data: bytes) -> bool:
    """Whether a sound line, a reply or an identity, ends with its SUM."""
    return data.count(b",") == 4 if data.startswith(b"A ") else data.count(b" ") == 3


class SetFramer:
    """Cuts what a station sends into lines and single ACK or NAK characters. Holds at most 128 bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._start = 0

    @property
    def pending(self) -> int:
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame | Garbage]:
        found: list[Frame | Garbage] = []
        for value in data:
            byte = bytes((value,))
            if byte in (CR, LF):
                found += self._line()
                self._start += 1
            elif byte in (ACK, NAK):
                found += self.flush("cut short by an acknowledgement")
                found.append(Frame(byte, self._start, self._start))
                self._start += 1
            else:
                self._buffer += byte
                if len(self._buffer) == _LINE_LIMIT:
                    found += self.flush(f"no end of line within {_LINE_LIMIT} bytes")
        return found

    def flush(self, reason: str) -> list[Garbage]:
        if not self._buffer:
            return []
        garbage = Garbage(bytes(self._buffer), reason, self._start, self._start + len(self._buffer) - 1)
        self._drop()
        return [garbage]

    def _line(self) -> list[Frame | Garbage]:
        """The line that ends here; what stands before a reply is clutter."""
        line, start = bytes(self._buffer), self._start
        if not line:
            return []
        self._drop()
        end = start + len(line) - 1
        reply = _REPLY.search(line)
        at = reply.start() if reply else 0
        clutter = [Garbage(line[:at], "clutter before a reply", start, start + at - 1)] if at else []
        return [*clutter, Frame(line[at:], start + at, end)]

    def _drop(self) -> None:
        self._start += len(self._buffer)
        self._buffer.clear()


def parse_reply(data: bytes, station: str, first_byte: Stamp, last_byte: Stamp) -> Fix:
    """The fix that a reply line carries.

    Args:
        data: the line without its end.
        station: name of the station.
        first_byte, last_byte: when the line's first and last bytes arrived.

    Returns:
        A fix; NOT_AVAILABLE, with the instrument's codes in `reason`, where a field reads Exxx or the distance is 0.

    Raises:
        RecordError: the line is no measurement, its SUM is wrong, or an angle is impossible.
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
    """The instrument that an `A <name>,<serial>,<ROM>,<EDM>[,SUM]` line names, in words.

    Raises:
        RecordError: not such a line, or its SUM is wrong.
    """
    fields = data.decode("latin-1").removeprefix("A ").split(",")
    if not data.startswith(b"A ") or len(fields) not in (4, 5) or not data.isascii() or not all(fields):
        raise RecordError(f"expected A NAME,SERIAL,ROM,EDM[,SUM], found {data.decode('latin-1')!r}")
    if len(fields) == 5 and checksum(data[:-2]) != data[-2:]:
        raise RecordError(f"SUM is {fields[4]}, computed {checksum(data[:-2]).decode()}")
    return f"{fields[0]}, serial number {fields[1]}, ROM {fields[2]}, EDM {fields[3]}"


def instrument_codes(fix: Fix) -> tuple[int, ...]:
    """The Exxx codes of a reply, in the order of its fields."""
    return tuple(int(field[1:]) for field in fix.raw.decode("ascii").split(" ") if field.startswith("E"))
