"""Files that an instrument or its office program wrote: their fixes, and how their columns were understood.

A new format is one new file in `drivers/stations/exports`, with its `FORMAT`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NoReturn

from pydantic import BaseModel, ConfigDict, Field

from drivers.errors import DescriptionError
from drivers.stations.survey import METRES_PER_FOOT

LengthUnit = Literal["mm", "cm", "m", "in", "ft"]
AngleUnit = Literal["deg", "gon", "rad"]
_Measured = Literal["x", "y", "z", "hz", "zenith", "distance"]
Role = Literal["point", _Measured, "prism", "prism_constant", "target_height", "station", "date", "time"]

MM_PER: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "ft": 1000 * METRES_PER_FOOT}
RAD_PER: dict[str, float] = {"deg": math.pi / 180, "gon": math.pi / 200, "rad": 1.0}


class ColumnMap(BaseModel):
    """Map of a file's columns: guessed from it, written beside the result, and given again with `--map`.

    Attributes:
        format: name of the format.
        separator: between columns; a blank stands for any white space.
        decimal: sign before the fraction of a number.
        header_line: line of the column names, from 1; 0 without one.
        first_line: the first line of data.
        length_unit: of coordinates and distances.
        angle_unit: of angles.
        time_format: as `strptime` has it; "" for seconds, or ISO times.
        rate_hz: frames a second, where the file counts frames.
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
    """A fix as a file has it.

    Attributes:
        line: where it stands, from 1.
        point: number or name of the point.
        target: what was measured, as the file says it: a code, a marker; "" where it says nothing.
        position_mm: east, north, up from the instrument's centre, where the file tells where that is.
        time_s: when; seconds since 1970 where the file has a date, else since its own origin; None where it says
            nothing.
        station: where the instrument stood, as the file names it; another name is another set-up.
        times_set_up: how often the file had set the instrument up by then, under any name; 0 where it does not say.
        prism_constant_mm: that the instrument applied to the distance; None where the file does not say.
        target_height_mm: of the prism above the place whose coordinates the file has; None where it does not say.
        is_numbered: whether the file does not name the point, so that its number is that of the row.
        has_zone: whether the time is of a named time zone; None where it is no date.
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
    """Conclusions on how a file is to be read.

    Attributes:
        map: the columns.
        notes: sentences about what was concluded, and from what.
    """

    map: ColumnMap
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ExportFormat:
    """A format of files.

    Attributes:
        name: in maps.
        title: for people.
        rank: formats of a lower one are tried first.
        recognises: whether a text is of this format.
        guess: concludes from a text how to read it; gets the file's name for messages.
        read: reads the fixes of a text.
        passed_over: notes on the records of a text that look like points and are none; gets the file's name as well.
    """

    name: str
    title: str
    rank: int
    recognises: Callable[[str], bool]
    guess: Callable[[str, str], Guess]
    read: Callable[[str, ColumnMap, str], list[ExportedFix]]
    passed_over: Callable[[str, str], tuple[str, ...]] = lambda _text, _source: ()


def polar_position_mm(hz_rad: float, zenith_rad: float, distance_mm: float) -> tuple[float, float, float]:
    """Return east, north, up of a point by horizontal angle (clockwise from north), zenith angle and slope distance."""
    level_mm = distance_mm * math.sin(zenith_rad)
    return level_mm * math.sin(hz_rad), level_mm * math.cos(hz_rad), distance_mm * math.cos(zenith_rad)


def refuse(source: str, reason: str, line: int | None = None, column: str | int | None = None) -> NoReturn:
    """Raise DescriptionError for a file, with line, column and reason."""
    place = source + (f", line {line}" if line is not None else "")
    raise DescriptionError(place + (f", column {column}" if column is not None else ""), reason)
