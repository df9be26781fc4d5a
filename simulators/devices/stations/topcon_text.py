"""Records of Topcon-type stations: frames with their block check, angles in degrees-minutes-seconds.

Written only for the simulator; the drivers have an independent reader of the same format.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce
from operator import xor

ETX = b"\x03"
ACK = b"\x06"
NAK = b"\x15"

_EARTH_RADIUS_M = 6_372_000.0
_REFRACTION = 0.20


@dataclass(frozen=True)
class Sight:
    """One measurement as displayed by the instrument.

    Attributes:
        hz_deg, zenith_deg: circle readings, 0 to below 360.
        slope_m: displayed slope distance; 0 if there is none.
        tilt_ok: the compensator works.
        edm_level: strength of the returned signal, 0 to 99.
        ppm, prism_mm: corrections set on the instrument.
        battery: 0 to 9.
        tracking: tracking flag of robotic stations, 0 to 6.
        face: 1 or 2.
    """

    hz_deg: float
    zenith_deg: float
    slope_m: float
    tilt_ok: bool = True
    edm_level: int = 15
    ppm: float = 0.0
    prism_mm: float = 0.0
    battery: int = 0
    tracking: int = 0
    face: int = 1

    @property
    def horizontal_m(self) -> float:
        """Horizontal distance, corrected for curvature and refraction."""
        V = math.radians(self.zenith_deg)
        level = self.slope_m * math.sin(V)
        bend = (1 - _REFRACTION / 2) * self.slope_m**2 * math.sin(V) * math.cos(V) / _EARTH_RADIUS_M
        return level - bend


def frame(data: bytes, *, crlf: bool) -> bytes:
    """Return `data` with its block check (XOR of all bytes as three decimal digits) and terminator."""
    return data + _check(data) + ETX + (b"\r\n" if crlf else b"")


def checked(block: bytes) -> bytes | None:
    """Return the data of a block without its ETX; None if the block check is wrong."""
    data, digits = block[:-3], block[-3:]
    return data if digits == _check(data) else None


def _check(data: bytes) -> bytes:
    return b"%03d" % reduce(xor, data, 0)


def dms(degrees: float, *, tenths: bool) -> str:
    """Format degrees as DDDMMSS, or as DDDMMSSs with tenths of a second."""
    scale = 36000 if tenths else 3600
    units = round(degrees * scale) % (360 * scale)
    per_second = 10 if tenths else 1
    seconds, part = divmod(units, per_second)
    minutes, second = divmod(seconds, 60)
    degree, minute = divmod(minutes, 60)
    return f"{degree:03d}{minute:02d}{second:02d}" + (f"{part:d}" if tenths else "")


def from_dms(text: str) -> float:
    """Parse DDDMMSS or DDDMMSSs, with or without a sign, as degrees."""
    sign = -1.0 if text.startswith("-") else 1.0
    digits = text.lstrip("+-")
    seconds = int(digits[5:7]) + (int(digits[7]) / 10 if len(digits) > 7 else 0.0)
    return sign * (int(digits[:3]) + int(digits[3:5]) / 60 + seconds / 3600)


def _signed(value: float, digits: int) -> str:
    limit = 10**digits - 1
    number = max(-limit, min(limit, round(value)))
    return f"{'-' if number < 0 else '+'}{abs(number):0{digits}d}"


def _distance_record(s: Sight, *, is_fine: bool) -> str:
    """Return distances, angles and corrections, in 0.1 mm and 0.1 arc second if fine, else in 1 mm and 1 arc second."""
    if is_fine:
        per_m, digits, corrections = 1e4, 9, _signed(s.ppm * 10, 4) + _signed(s.prism_mm * 10, 3)
    else:
        per_m, digits, corrections = 1e3, 8, _signed(s.ppm, 2) + _signed(s.prism_mm, 2)
    return (
        f"{_signed(s.slope_m * per_m, digits)}m{dms(s.zenith_deg, tenths=is_fine)}+{dms(s.hz_deg, tenths=is_fine)}d"
        f"{_signed(s.horizontal_m * per_m, digits)}{'t' if s.tilt_ok else '*'}{s.edm_level:02d}{corrections}"
    )


def tracking_record(s: Sight) -> bytes:
    """Return a `Q` record: slope distance of a robotic station."""
    state = f"{s.battery}0{s.tracking}{'r' if s.face == 1 else 'l'}"
    return f"Q{_distance_record(s, is_fine=True)}{state}".encode("ascii")


def tracking_angles(s: Sight) -> bytes:
    """Return a `Q` record with only angles, the answer to `C31`."""
    return f"Q{dms(s.zenith_deg, tenths=True)}+{dms(s.hz_deg, tenths=True)}d".encode("ascii")


def fine_record(s: Sight) -> bytes:
    """Return a `(` record: slope distance in fine mode."""
    return f"({_distance_record(s, is_fine=True)}**".encode("ascii")


def coarse_record(s: Sight) -> bytes:
    """Return a `?` record: slope distance in coarse mode."""
    return f"?{_distance_record(s, is_fine=False)}".encode("ascii")


def angle_record(s: Sight) -> bytes:
    """Return a `<` record: only circle readings."""
    return f"<{dms(s.zenith_deg, tenths=False)}+{dms(s.hz_deg, tenths=False)}+0000d".encode("ascii")


def coordinate_record(s: Sight) -> bytes:
    """Return a `U` record: north, east and height of the target from the instrument's centre, mm."""
    V, H = math.radians(s.zenith_deg), math.radians(s.hz_deg)
    level = s.slope_m * math.sin(V)
    north, east, up = level * math.cos(H), level * math.sin(H), s.slope_m * math.cos(V)
    coordinates = "".join(_signed(value * 1e3, 8) for value in (north, east, up))
    return f"U{coordinates}m+{dms(s.hz_deg, tenths=False)}d".encode("ascii")


def set_record(s: Sight, *, checksum: bool) -> bytes:
    """Return a Sokkia SET reply: slope distance in mm, zenith and horizontal angle DDDMMSS; E200 for no distance."""
    distance = f"{round(s.slope_m * 1e3):07d}" if s.slope_m else "E200"
    text = f"{distance} {dms(s.zenith_deg, tenths=False)} {dms(s.hz_deg, tenths=False)}".encode("ascii")
    return set_line(text + b" ", checksum=True) if checksum else text + b"\r\n"


def set_line(text: bytes, *, checksum: bool) -> bytes:
    """Return a SET line: `text` with its separator, the sum of its bytes as two hexadecimal digits, CR LF."""
    return text + (b"%02X" % (sum(text) % 256) if checksum else b"") + b"\r\n"
