"""Sokkia SDR33 files: one record per line, with a code of four characters and columns of 16 characters.

    00NM  version, date, units (angle 1 degrees, 2 gon; distance 1 metres, 2 feet)    03NM  height of the target
    10NM  job
    02TP  point, north, east, elevation, height of the instrument: where the instrument stands
    07TP  station, back-sight, its azimuth, circle reading to it
    08TP  point, north, east, elevation, description
    09F1  station, point, slope distance, zenith angle, horizontal angle, description (09F2: face 2)

The last two characters of a code show where a record comes from: TP is measured, F1 and F2 are readings in one face, KI
is typed in on the keyboard, RS, SO, TV and others are results of programs. The only coordinates used are those of 08TP.

Columns, including the last one, are padded with blanks, except heights of targets.

A number after the last record is a checksum; no source documents how it is computed, so it is skipped. Positions are
relative to the instrument's centre if the file contains its place, and are those of the prism, not of the ground below
it. North is the north of the job for coordinates, and the zero of the circle for polar measurements.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from drivers.stations.export_format import (
    MM_PER,
    RAD_PER,
    AngleUnit,
    ColumnMap,
    ExportedFix,
    ExportFormat,
    Guess,
    LengthUnit,
    measured_mm,
    polar_position_mm,
    refuse,
)
from drivers.stations.tables.cells import lines_of, number_of, why_no_number

_CODE, _WIDTH = 4, 16
_MARKS = "\ufeff\r\n\x02 "  # allowed before the first record
_UNITS = re.compile(r"(?P<angle>[1-4])(?P<length>[1-3])[1-9]{4}\s*$")
_PASSED_OVER = {"01", "04", "05", "06", "11", "12", "13"}  # notes, corrections, computed results
_SETS_UP = {"02", "07", "10"}
_MEASURED, _COORDINATES = "08TP", "08"
_NOT_MEASURED = {"08KI": "coordinates typed in, not measured"}
_LENGTHS: dict[str, LengthUnit] = {"1": "m", "2": "ft"}
_ANGLES: dict[str, AngleUnit] = {"1": "deg", "2": "gon"}
_SAME_FRAME_RAD = 1e-5  # between the zero of the circle and the coordinates' north: 0.1 mm at 10 m
_SAME_ZERO_RAD = 1e-4  # between two back-sights: pointing errors are smaller, a newly set circle differs by more


def _recognises(text: str) -> bool:
    return text.lstrip(_MARKS).startswith("00NMSDR")


def _guess(text: str, source: str) -> Guess:
    head = lines_of(text.lstrip(_MARKS))[0]
    if not head.startswith("00NMSDR33"):
        refuse(source, f"{head[4:12].strip()} has different column widths; export the job as SDR33", 1)
    units = _units(head, 1, source)
    if units is None:
        refuse(source, "the header does not contain the units (six digits at its end); export the job again", 1)
    columns = ColumnMap(format=FORMAT.name, length_unit=units[0], angle_unit=units[1])
    fixes = _read(text, columns, source)
    return Guess(columns, (f"{len(fixes)} points; the header gives {columns.length_unit} and {columns.angle_unit}",))


def _units(head: str, line: int, source: str) -> tuple[LengthUnit, AngleUnit] | None:
    """Return the units in a header, or None if it contains none."""
    found = _UNITS.search(head)
    if found is None:
        return None
    if found["angle"] not in _ANGLES or found["length"] not in _LENGTHS:
        refuse(source, "angles in mil and distances in US feet are not supported: use degrees or gon, and metres", line)
    return _LENGTHS[found["length"]], _ANGLES[found["angle"]]


def _read(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    reading = _Reading(columns, source)
    for line, record in _records(text):
        reading.take(line, record)
    if not reading.fixes:
        passed = "".join(f"; {note}" for note in _passed_over(text, source))
        refuse(source, f"the file has no measured point (records 08TP, 09F1 or 09F2){passed}")
    return reading.fixes


def _records(text: str) -> Iterator[tuple[int, str]]:
    """Yield the records of a file, each with its line number from 1."""
    for number, line in enumerate(lines_of(text), 1):
        record = line.lstrip("\x02\x03\x04\x1a ").rstrip("\x02\x03\x04\x1a\r\n")
        if record and not record.strip().isdigit():
            yield number, record


def _passed_over(text: str, source: str) -> tuple[str, ...]:
    """Return a note on each kind of coordinate record that is not a measured point."""
    lines: dict[str, list[int]] = {}
    for number, record in _records(text):
        code = record[:_CODE]
        if code.startswith(_COORDINATES) and code != _MEASURED:
            lines.setdefault(code, []).append(number)
    notes = []
    for code, found in lines.items():
        many = f"1 record {code}" if len(found) == 1 else f"{len(found)} records {code}"
        why = _NOT_MEASURED.get(code, f"not known to be measured, unlike {_MEASURED}")
        notes.append(f"{source} has {many}, from line {found[0]} on: {why}; skipped")
    return tuple(notes)


@dataclass
class _Reading:
    """Reads a file record by record and keeps the state up to the current record.

    Attributes:
        columns: the map; its units are used.
        source: name of the file, for error messages.
        fixes: fixes read so far.
        job: name of the open job.
        station: name of the station where the instrument stands.
        origin_mm: east, north and height of the instrument's centre there.
        stood_mm: station -> its origin.
        turns_rad: station -> azimuth of the circle's zero from its back-sight; None if that is not a number.
        coordinates: station -> line of its first coordinates.
        turned: station -> line of its first polar measurement that is not known to be in the frame of coordinates.
        zeros: station -> line of the first polar measurement after a back-sight, and azimuth of the circle's zero then.
        units: units from the header; None before the header, and if it contains none.
        target_mm: height of the target.
        times_set_up: number of set-ups of the instrument so far.
        has_measured: True if there was a measurement since the last set-up.
    """

    columns: ColumnMap
    source: str
    fixes: list[ExportedFix] = field(default_factory=list)
    job: str = ""
    station: str = ""
    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stood_mm: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    turns_rad: dict[str, float | None] = field(default_factory=dict)
    coordinates: dict[str, int] = field(default_factory=dict)
    turned: dict[str, int] = field(default_factory=dict)
    zeros: dict[str, tuple[int, float]] = field(default_factory=dict)
    units: tuple[LengthUnit, AngleUnit] | None = None
    target_mm: float = 0.0
    times_set_up: int = 0
    has_measured: bool = True

    def take(self, line: int, record: str) -> None:
        """Process one record."""
        code, cells = record[:_CODE], _cells(record)
        if self.has_measured and code[:2] in _SETS_UP:
            self.times_set_up, self.has_measured = self.times_set_up + 1, False
        match code[:2]:
            case "00":
                self._begin(line, record)
            case "10":
                self.job = _name(cells, 0)
                self.station, self.origin_mm, self.target_mm = _station(self.job, ""), (0.0, 0.0, 0.0), 0.0
                self.turns_rad.clear()
            case "02":
                self._stand(line, code, cells)
            case "07":
                self._sight_back(cells)
            case "03":
                self.target_mm = self._lengths_mm([record[_CODE:]], (0,), line, code)[0]
            case "08" if code == _MEASURED:
                self._take_coordinates(line, code, cells)
            case "09" if code in ("09F1", "09F2"):
                self._take_polar(line, code, cells)
            case kind if kind not in _PASSED_OVER | {_COORDINATES}:
                refuse(self.source, f"unknown kind of record {code!r}; remove it or export the job again", line)

    def _begin(self, line: int, head: str) -> None:
        units = _units(head, line, self.source)
        map_units = (self.columns.length_unit, self.columns.angle_unit)
        if self.units and units != self.units:
            refuse(self.source, "a second header has different units than the first; save each part as a file", line)
        if units is not None and units != map_units:
            said = f"the header has units {' and '.join(units)}, the map {' and '.join(map_units)}"
            refuse(self.source, f"{said}; correct length_unit and angle_unit of the map", line)
        self.units = units

    def _stand(self, line: int, code: str, cells: list[str]) -> None:
        north, east, up, height = self._lengths_mm(cells, (1, 2, 3, 4), line, code)
        self.station, origin_mm = _station(self.job, _name(cells, 0)), (east, north, up + height)
        before_mm = self.stood_mm.setdefault(self.station, origin_mm)
        if before_mm != origin_mm and any(fix.station == self.station for fix in self.fixes):
            problem = f"the station {self.station!r} has a second place; rename it, or split the file"
            refuse(self.source, f"{problem} into one file per set-up", line)
        self.stood_mm[self.station] = self.origin_mm = origin_mm
        self.turns_rad.pop(self.station, None)

    def _sight_back(self, cells: list[str]) -> None:
        azimuth, circle = (number_of(_name(cells, place), ".") for place in (2, 3))
        turn = None if azimuth is None or circle is None else azimuth - circle
        self.turns_rad[self._named(cells)] = None if turn is None else turn * RAD_PER[self.columns.angle_unit]

    def _take_coordinates(self, line: int, code: str, cells: list[str]) -> None:
        north, east, up = self._lengths_mm(cells, (1, 2, 3), line, code)
        measured_mm((north, east, up), self.source, line)
        origin_mm = self.origin_mm
        place = (east - origin_mm[0], north - origin_mm[1], up + self.target_mm - origin_mm[2])
        self.coordinates.setdefault(self.station, line)
        self._add(line, self.station, _name(cells, 0), _name(cells, 4), place)

    def _take_polar(self, line: int, code: str, cells: list[str]) -> None:
        distance, zenith, hz = (_number(cells, place, code, line, self.source) for place in (2, 3, 4))
        mm, rad = MM_PER[self.columns.length_unit], RAD_PER[self.columns.angle_unit]
        place = polar_position_mm(hz * rad, zenith * rad, distance * mm, self.source, line)
        at = self._named(cells)
        turn_rad = self.turns_rad.get(at)
        if turn_rad is None or abs(math.remainder(turn_rad, math.tau)) > _SAME_FRAME_RAD:
            self.turned.setdefault(at, line)
        if turn_rad is not None:
            first, zero_rad = self.zeros.setdefault(at, (line, turn_rad))
            if abs(math.remainder(turn_rad - zero_rad, math.tau)) > _SAME_ZERO_RAD:
                turned = (
                    f"by its back-sight, the circle of the station {at!r} has a different zero than in line {first}"
                )
                refuse(self.source, f"{turned}; split the file in two and import each as a separate set-up", line)
        self._add(line, at, _name(cells, 1), _name(cells, 5), place)

    def _add(self, line: int, station: str, point: str, target: str, place: tuple[float, float, float]) -> None:
        if station in self.coordinates and station in self.turned:
            both = f"coordinates (line {self.coordinates[station]}) and angles (line {self.turned[station]})"
            why = "no back-sight (07) shows that the circle's zero is the north of the coordinates"
            todo = "split the file in two and import each as a separate set-up"
            refuse(self.source, f"{both} of the station {station!r} may be in two frames, as {why}; {todo}", line)
        fix = ExportedFix(line, point, target, place, station=station, times_set_up=self.times_set_up)
        self.fixes.append(fix)
        self.has_measured = True

    def _named(self, cells: list[str]) -> str:
        """Return the station named in a record's first column; if it is empty, the instrument's current station."""
        return _station(self.job, _name(cells, 0)) if _name(cells, 0) else self.station

    def _lengths_mm(self, cells: list[str], places: tuple[int, ...], line: int, code: str) -> list[float]:
        mm = MM_PER[self.columns.length_unit]
        return [_number(cells, place, code, line, self.source) * mm for place in places]


def _station(job: str, name: str) -> str:
    return "/".join(filter(None, (job, name)))


def _cells(record: str) -> list[str]:
    return [record[at : at + _WIDTH] for at in range(_CODE, len(record), _WIDTH)]


def _name(cells: list[str], place: int) -> str:
    return cells[place].strip() if place < len(cells) else ""


def _number(cells: list[str], place: int, code: str, line: int, source: str) -> float:
    text = _name(cells, place)
    value = number_of(text, ".")
    if value is None:
        refuse(source, f"{why_no_number(text)}, in column {place + 1} of a record {code}", line)
    if len(cells[place]) < _WIDTH and not code.startswith("03"):
        said = (
            f"the record {code} ends with {text!r} within column {place + 1}: it is truncated or lost trailing blanks"
        )
        refuse(source, f"{said}; export the file again", line)
    return value


FORMAT = ExportFormat(
    name="sokkia_sdr",
    title="Sokkia SDR33",
    rank=20,
    recognises=_recognises,
    guess=_guess,
    read=_read,
    passed_over=_passed_over,
)
