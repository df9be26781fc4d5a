"""Angles, units, plausibility checks and positions for the records of all total stations."""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.readings import Fix, Status

# International foot. (The US survey foot is 2 ppm longer: 0.2 mm in 100 m.)
METRES_PER_FOOT = 0.3048

# The longest distance that the distance meters of these families measure to a single prism under good conditions
RANGE_MAX_M = 6000.0

# Horizontal and slope distance of one record may differ from SD * sin(V) by curvature and refraction (millimetres at
# these ranges) and rounding. A larger share of SD means wrong digits that the checksum did not catch.
HORIZONTAL_DISTANCE_TOLERANCE = 0.01
HORIZONTAL_DISTANCE_SLACK_M = 0.05


class RecordError(Exception):
    """A record does not follow its layout or is inconsistent; the message states what was expected and found."""


def circle_angle_rad(digits: str, unit: str) -> float:
    """Convert an angle in the format of total stations to radians, 0 <= angle < 2 pi.

    Args:
        digits: for `d` (degrees, minutes, seconds) DDDMMSS or DDDMMSSs, the eighth digit being tenths of a second;
            for `g` (gon) 7 digits of 0.0001 gon or 8 digits of 0.00001 gon.
        unit: `d` or `g`.

    Raises:
        RecordError: minutes or seconds are 60 or more, or the angle is a full circle or more.
    """
    if unit == "g":
        gon = int(digits) / 10 ** (len(digits) - 3)
        if gon >= 400:
            raise RecordError(f"angle {digits} is not below 400 gon")
        return math.radians(gon * 0.9)
    degrees, minutes, seconds = int(digits[:3]), int(digits[3:5]), int(digits[5:]) / 10 ** (len(digits) - 7)
    if degrees >= 360 or minutes >= 60 or seconds >= 60:
        raise RecordError(f"angle {digits} must have degrees below 360, and minutes and seconds below 60")
    return math.radians(degrees + minutes / 60 + seconds / 3600)


def signed_circle_angle_rad(digits: str, unit: str) -> float:
    """Convert a signed horizontal angle to a clockwise angle, 0 <= angle < 2 pi; -X degrees is the same as 360 - X.

    Args:
        digits: sign, then the digits for `circle_angle_rad`.
        unit: `d` or `g`.

    Raises:
        RecordError: see `circle_angle_rad`.
    """
    angle = circle_angle_rad(digits[1:], unit)
    return 2 * math.pi - angle if digits[0] == "-" and angle > 0 else angle


def face_of(zenith_angle_rad: float) -> int:
    """Return 1 (telescope direct) or 2 (reversed: the vertical circle reads more than 180 degrees)."""
    return 2 if zenith_angle_rad > math.pi else 1


def check_horizontal_distance(slope_m: float, zenith_angle_rad: float, horizontal_m: float) -> None:
    """Refuse a record whose horizontal distance grossly contradicts SD * sin(V).

    The horizontal distance is not used otherwise, because it may contain the instrument's own correction for curvature
    and refraction. Its redundant digits reveal pairs of bit errors, which a three-digit XOR does not detect.

    Args:
        slope_m: slope distance SD.
        zenith_angle_rad: zenith angle V.
        horizontal_m: horizontal distance in the record.

    Raises:
        RecordError: the distances differ by more than 1 % of SD and more than 50 mm.
    """
    computed_m = slope_m * abs(math.sin(zenith_angle_rad))
    tolerance_m = max(HORIZONTAL_DISTANCE_TOLERANCE * slope_m, HORIZONTAL_DISTANCE_SLACK_M)
    if abs(computed_m - abs(horizontal_m)) > tolerance_m:
        raise RecordError(
            f"horizontal distance {horizontal_m:.4f} m contradicts slope distance and zenith angle, which give "
            f"{computed_m:.4f} m"
        )


def range_checked(fix: Fix, max_range_m: float) -> Fix:
    """Return the fix, with status OUT_OF_RANGE if it is farther away than the instrument can measure.

    A three-digit XOR does not detect pairs of bit errors, and coordinates have no redundant digits at all.
    """
    if fix.status is not Status.OK:
        return fix
    if fix.slope_distance_m is not None:
        if fix.slope_distance_m <= max_range_m:
            return fix
        reason = f"slope distance {fix.slope_distance_m:.3f} m exceeds max_range_m = {max_range_m:g}"
    else:
        away_m = math.hypot(fix.north_m or 0.0, fix.east_m or 0.0, fix.up_m or 0.0)
        if away_m <= max_range_m:
            return fix
        reason = (
            f"coordinates {away_m:.3f} m from their origin exceed max_range_m = {max_range_m:g}: set the station's "
            "own coordinates to 0 on the instrument"
        )
    return replace(fix, status=Status.OUT_OF_RANGE, reason=reason)


def position_mm(fix: Fix) -> tuple[float, float, float] | None:
    """Compute the position in the station's frame: (x east, y north, z up) in mm from the instrument's centre.

    The position is computed from slope distance and both circles if the record has them (in either face), else from the
    instrument's own coordinates (NEZ records, reordered). None if the fix has neither, or its status is not OK.
    """
    if fix.status is not Status.OK:
        return None
    hz, zenith, slope_m = fix.hz_angle_rad, fix.zenith_angle_rad, fix.slope_distance_m
    if hz is not None and zenith is not None and slope_m is not None:
        level_mm = 1000 * slope_m * math.sin(zenith)
        return level_mm * math.sin(hz), level_mm * math.cos(hz), 1000 * slope_m * math.cos(zenith)
    if fix.east_m is not None and fix.north_m is not None and fix.up_m is not None:
        return 1000 * fix.east_m, 1000 * fix.north_m, 1000 * fix.up_m
    return None
