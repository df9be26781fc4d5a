"""Files written by an instrument or its office program: their fixes, and the interpretation of their columns.

To add a format, add a file with a `FORMAT` to `drivers/stations/exports`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NoReturn

from pydantic import BaseModel, ConfigDict, Field

from drivers.errors import DescriptionError
from drivers.stations.survey import METRES_PER_FOOT, RANGE_MAX_M

LengthUnit = Literal["mm", "cm", "m", "in", "ft"]
AngleUnit = Literal["deg", "gon", "rad"]
_Measured = Literal["x", "y", "z", "hz", "zenith", "distance"]
Role = Literal["point", _Measured, "prism", "prism_constant", "target_height", "station", "date", "time"]

MM_PER: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "ft": 1000 * METRES_PER_FOOT}
RAD_PER: dict[str, float] = {"deg": math.pi / 180, "gon": math.pi / 200, "rad": 1.0}


class ColumnMap(BaseModel):
    """Map of a file's columns: guessed from the file, written next to the result, and passed again with `--map`.

    Attributes:
        format: name of the format.
        separator: separator between columns; a blank means any white space.
        decimal: decimal sign.
        header_line: line of the column names, from 1; 0 if there is none.
        first_line: first line of data, from 1.
        length_unit: unit of coordinates and distances.
        angle_unit: unit of angles.
        time_format: format of times for `strptime`; "" for seconds or ISO times.
        rate_hz: frames per second, if the file counts frames.
        columns: role -> name of the column, or its number from 1.
        prisms: name of a point, a code or a marker in the file -> prism of the rig.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: str
    separator: Literal[",", ";", "\t", " "] = ","
    decimal: Literal[".", ","] = "."
    header_line: int = Field(default=0, ge=0)
    first_line: int = Field(default=1, ge=1)
    length_unit: LengthUnit = "mm"
    angle_unit: AngleUnit = "deg"
    time_format: str = ""
    rate_hz: float | None = Field(default=None, gt=0)
    columns: dict[Role, str | int] = Field(default_factory=dict)
    prisms: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ExportedFix:
    """A fix from a file.

    Attributes:
        line: line in the file, from 1.
        point: number or name of the point.
        target: what was measured, as a code or marker of the file; "" if the file does not contain it.
        position_mm: east, north, up; from the instrument's centre if the file contains the centre's position.
        time_s: seconds since 1970 if the file has a date, else since the file's own origin; None if it has no times.
        station: the file's name for the place of the instrument; a different name is a different set-up.
        times_set_up: number of set-ups in the file up to this fix, under any name; 0 if the file does not record them.
        prism_constant_mm: constant that the instrument applied to the distance; None if the file does not contain it.
        target_height_mm: height of the prism above the place whose coordinates the file has; None if the file does not
            contain it.
        is_numbered: the file does not name the point, so its number is the number of the row.
        has_zone: the time has a known time zone; None if it is not a date.
    """

    line: int
    point: str
    target: str
    position_mm: tuple[float, float, float]
    time_s: float | None = None
    station: str = ""
    times_set_up: int = 0
    prism_constant_mm: float | None = None
    target_height_mm: float | None = None
    is_numbered: bool = False
    has_zone: bool | None = None


@dataclass(frozen=True)
class Guess:
    """The guessed interpretation of a file.

    Attributes:
        map: map of the columns.
        notes: sentences about the conclusions and their reasons.
    """

    map: ColumnMap
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ExportFormat:
    """A file format.

    Attributes:
        name: name in maps.
        title: name for people.
        rank: formats with a lower rank are tried first.
        recognises: returns True if a text is of this format.
        guess: guesses from (text, file name) how to read the text; the file name is for error messages.
        read: reads the fixes from (text, map, file name).
        passed_over: returns for (text, file name) notes on skipped records that look like points but are not.
    """

    name: str
    title: str
    rank: int
    recognises: Callable[[str], bool]
    guess: Callable[[str, str], Guess]
    read: Callable[[str, ColumnMap, str], list[ExportedFix]]
    passed_over: Callable[[str, str], tuple[str, ...]] = lambda _text, _source: ()


def polar_position_mm(
    hz_rad: float, zenith_rad: float, distance_mm: float, source: str, line: int
) -> tuple[float, float, float]:
    """Return east, north, up in mm from horizontal angle (clockwise from north), zenith angle and slope distance.

    Raises:
        DescriptionError: the distance is none that a total station measures; names `source` and `line`.
    """
    if not 0.0 < distance_mm <= 1000.0 * RANGE_MAX_M:
        said = f"the distance {distance_mm / 1000:g} m is not between 0 and {RANGE_MAX_M:g} m"
        refuse(source, f"{said}: nothing was measured, or the unit is wrong; correct or remove the line", line)
    level_mm = distance_mm * math.sin(zenith_rad)
    return level_mm * math.sin(hz_rad), level_mm * math.cos(hz_rad), distance_mm * math.cos(zenith_rad)


def measured_mm(place_mm: tuple[float, float, float], source: str, line: int) -> tuple[float, float, float]:
    """Return coordinates unless all of them are exactly zero, which is how programs write that nothing was measured.

    Raises:
        DescriptionError: all three are zero; names `source` and `line`.
    """
    if place_mm == (0.0, 0.0, 0.0):
        refuse(source, "all coordinates are zero: nothing was measured; remove the line", line)
    return place_mm


def refuse(source: str, reason: str, line: int | None = None, column: str | int | None = None) -> NoReturn:
    """Raise DescriptionError for a file, with line, column and reason.

    Args:
        source: name of the file.
        reason: the fault and what to do.
        line: line number, from 1, if known.
        column: number or name of the column, if known.
    """
    place = source + (f", line {line}" if line is not None else "")
    raise DescriptionError(place + (f", column {column}" if column is not None else ""), reason)
