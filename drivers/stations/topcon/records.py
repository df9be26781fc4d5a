"""Records of the Topcon GTS protocol, which are the data of frames. Layouts: `?` `(` `<` `U` `/` `Q`.

Vertical angles are counted from the zenith (0 = up); the instruments must be set accordingly. A record with any
character that does not fit its layout is refused as a whole.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from drivers.clock import Stamp
from drivers.readings import Fix, LockState, Status
from drivers.stations.survey import (
    METRES_PER_FOOT,
    RecordError,
    check_horizontal_distance,
    circle_angle_rad,
    face_of,
    signed_circle_angle_rad,
)

_SLOPE_MM = re.compile(
    r"\?(?P<sd>[+-]\d{8})(?P<unit>[mfi])(?P<v>\d{7})(?P<h>[+-]\d{7})(?P<angle>[dg])(?P<hd>[+-]\d{8})"
    r"(?P<tilt>[t?*])(?P<level>\d\d|\*\*)(?P<ppm>[+-]\d\d)(?P<prism>[+-]\d\d)"
)
_SLOPE_TENTH_MM = (
    r"(?P<sd>[+-]\d{9})(?P<unit>[mfi])(?P<v>\d{8})(?P<h>[+-]\d{8})(?P<angle>[dg])(?P<hd>[+-]\d{9})"
    r"(?P<tilt>[t?*])(?P<level>\d\d|\*\*)(?P<ppm>[+-]\d{4})(?P<prism>[+-]\d{3})"
)
_SLOPE_FINE = re.compile(r"\(" + _SLOPE_TENTH_MM + r"[!-~]{2}")  # two characters of unknown meaning, observed as `**`
_TRACKING = re.compile(r"Q" + _SLOPE_TENTH_MM + r"(?P<battery>\d)(?P<edm>\d)(?P<flag>\d)(?P<face>[rl])")
_ANGLES = re.compile(r"<(?P<v>\d{7})(?P<h>[+-]\d{7})(?P<tilt>[+-]\d{4})(?P<angle>[dg])")
# Coordinates have ten digits each, or eight each; in the latter form a number too large for eight digits has ten.
_LONG, _SHORT = r"[+-]\d{10}", r"[+-](?:\d{8}|(?!00)\d{10})"
_COORDINATES = re.compile(
    rf"(?P<header>[U/])(?={_LONG}{_LONG}{_LONG}[mfi]|{_SHORT}{_SHORT}{_SHORT}[mfi])"
    r"(?P<n>[+-]\d+)(?P<e>[+-]\d+)(?P<z>[+-]\d+)(?P<unit>[mfi])(?P<h>[+-]\d{7,8})(?P<angle>[dg])"
)

_TILT_UNCORRECTED = {
    "?": "the compensator is out of range: level the instrument",
    "*": "the compensator is off: switch it on",
}
_TRACKING_FLAG = {
    0: (LockState.STANDBY, "tracking is switched off"),
    1: (LockState.LOCKED, ""),
    2: (LockState.SEARCHING, "the station is searching for the prism"),
    3: (LockState.WAITING, "the station has lost the prism and waits"),
    4: (LockState.ROTATING, "the station is rotating"),
    5: (LockState.ROTATING, "the station is rotating"),
    6: (LockState.ERROR, "the station is recovering from an error (zero detection)"),
}


@dataclass(frozen=True, slots=True)
class CorrectionScales:
    """Units of the corrections in `(` and `Q` records; no source documents them.

    The defaults fit the instruments' ranges exactly: -999.9 to +999.9 ppm need a sign and four digits, and -99.9 to
    +99.9 mm a sign and three digits. `?` records have two digits each, of 1 ppm and 1 mm. The corrections are only
    recorded; displayed distances already contain them.

    Attributes:
        ppm: ppm per count of the atmospheric correction.
        prism_mm: mm per count of the prism constant.
    """

    ppm: float = 0.1
    prism_mm: float = 0.1


def parse_record(
    data: bytes, station: str, first_byte: Stamp, last_byte: Stamp, scales: CorrectionScales = CorrectionScales()
) -> Fix:
    """Parse a record.

    Args:
        data: data of a frame with a correct BCC.
        station: name of the station.
        first_byte: when the record's first byte arrived.
        last_byte: when its last byte arrived.
        scales: units of the corrections in `(` and `Q` records.

    Returns:
        A fix; its status is NOT_AVAILABLE if there is no distance or the station is not locked, and OUT_OF_RANGE if the
        compensator is out of range or off, because its angles are then not corrected for the instrument's tilt.

    Raises:
        RecordError: the data does not follow the layout for its header, or is inconsistent.
    """
    text = data.decode("latin-1")
    make = partial(Fix, station=station, stamp=first_byte, last_byte=last_byte, raw=data)
    match text[:1]:
        case "?":
            return _slope(make, _matched(_SLOPE_MM, text), 1000, CorrectionScales(1.0, 1.0))
        case "(":
            return _slope(make, _matched(_SLOPE_FINE, text), 10_000, scales)
        case "Q":
            return _tracking(make, _matched(_TRACKING, text), scales)
        case "<":
            return _angles(make, _matched(_ANGLES, text))
        case "U" | "/":
            return _coordinates(make, _matched(_COORDINATES, text))
    raise RecordError(f"unknown record header {text[:1]!r}; known: ? ( < U / Q")


def _matched(layout: re.Pattern[str], text: str) -> re.Match[str]:
    match = layout.fullmatch(text)
    if match is None:
        raise RecordError(f"record does not follow the layout of {text[0]!r} records: {text!r}")
    return match


def _hz_angle_rad(match: re.Match[str]) -> float:
    return signed_circle_angle_rad(match["h"], match["angle"])


def _metres(digits: str, unit: str, counts_per_unit: int) -> float:
    if unit == "i":
        # The only program known to convert this divides the decimals by 1.16, which cannot be right with twelve inches
        # to a foot
        raise RecordError("distance is in feet and inches, whose coding is unknown; set the instrument to metres")
    return int(digits) / counts_per_unit * (METRES_PER_FOOT if unit == "f" else 1.0)


def _slope(make: Callable[..., Fix], match: re.Match[str], counts_per_unit: int, scales: CorrectionScales) -> Fix:
    """Parse `?`, `(` and the common part of `Q`."""
    zenith = circle_angle_rad(match["v"], match["angle"])
    slope_m = _metres(match["sd"], match["unit"], counts_per_unit)
    if slope_m < 0:
        raise RecordError(f"slope distance {match['sd']} is negative")
    status, reason = Status.OK, ""
    if slope_m == 0:
        status, reason = Status.NOT_AVAILABLE, "no distance"
    else:
        check_horizontal_distance(slope_m, zenith, _metres(match["hd"], match["unit"], counts_per_unit))
        if match["tilt"] in _TILT_UNCORRECTED:
            status, reason = Status.OUT_OF_RANGE, _TILT_UNCORRECTED[match["tilt"]]
    return make(
        status=status,
        lock=LockState.UNKNOWN,
        hz_angle_rad=_hz_angle_rad(match),
        zenith_angle_rad=zenith,
        slope_distance_m=slope_m or None,
        face=face_of(zenith),
        prism_constant_mm=int(match["prism"]) * scales.prism_mm,
        ppm=int(match["ppm"]) * scales.ppm,
        tilt_ok=match["tilt"] not in _TILT_UNCORRECTED,
        edm_level=None if match["level"] == "**" else int(match["level"]),
        reason=reason,
    )


def _tracking(make: Callable[..., Fix], match: re.Match[str], scales: CorrectionScales) -> Fix:
    """Parse `Q`: usable if the tracking flag is "locked" as well.

    The face is derived from the zenith angle, from which the position is computed, and not from the `r`/`l` flag.
    """
    fix = _slope(make, match, 10_000, scales)
    lock, why_not = _TRACKING_FLAG.get(int(match["flag"]), (LockState.UNKNOWN, "unknown tracking flag"))
    if lock is LockState.LOCKED:
        return replace(fix, lock=lock)
    return replace(fix, status=Status.NOT_AVAILABLE, lock=lock, reason=f"{why_not} (flag {match['flag']})")


def _angles(make: Callable[..., Fix], match: re.Match[str]) -> Fix:
    """Parse `<`: circles only."""
    zenith = circle_angle_rad(match["v"], match["angle"])
    return make(
        status=Status.NOT_AVAILABLE,
        lock=LockState.UNKNOWN,
        hz_angle_rad=_hz_angle_rad(match),
        zenith_angle_rad=zenith,
        face=face_of(zenith),
        reason="the record has only angles, no distance",
    )


def _coordinates(make: Callable[..., Fix], match: re.Match[str]) -> Fix:
    """Parse `U` (1 mm) and `/` (0.1 mm): the instrument's own N, E, Z and its horizontal circle."""
    counts_per_unit = 1000 if match["header"] == "U" else 10_000
    north_m, east_m, up_m = (_metres(match[name], match["unit"], counts_per_unit) for name in ("n", "e", "z"))
    has_distance = bool(north_m or east_m or up_m)  # nothing can be measured at the instrument's own centre
    return make(
        status=Status.OK if has_distance else Status.NOT_AVAILABLE,
        lock=LockState.UNKNOWN,
        hz_angle_rad=_hz_angle_rad(match),
        north_m=north_m if has_distance else None,
        east_m=east_m if has_distance else None,
        up_m=up_m if has_distance else None,
        reason="" if has_distance else "no distance",
    )
