"""Sokkia SDR33 files: one record a line, a code of four characters and columns of 16.

    00NM  version, date, units (angle 1 degrees, 2 gon; distance 1 metres, 2 feet)    03NM  height of the target
    10NM  job
    02TP  point, north, east, elevation, height of the instrument: where it stood    07TP  its back-sight
    08..  point, north, east, elevation, description
    09F1  station, point, slope distance, zenith angle, horizontal angle, description (09F2: face 2)

A number in digits after the last record is a check sum, whose rule no source states; it is passed over. Coordinates are
given from the instrument's centre, where the file says where it stood, and of the prism, not of the ground below it.
"""

from __future__ import annotations

import re
from dataclasses import replace

from drivers.stations.delimited import number_of, why_no_number
from drivers.stations.export_format import (
    MM_PER,
    RAD_PER,
    ColumnMap,
    ExportedFix,
    ExportFormat,
    Guess,
    LengthUnit,
    polar_position_mm,
    refuse,
)

_CODE, _WIDTH = 4, 16
_MARKS = "\ufeff\r\n\x02 "  # before the first record
_UNITS = re.compile(r"(?P<angle>[1-4])(?P<length>[1-3])[1-9]{4}\s*$")
_PASSED_OVER = {"00", "01", "04", "05", "06", "11", "12", "13"}  # notes, corrections, computed results
_SETS_UP = {"02", "07", "10"}
_LENGTHS: dict[str, LengthUnit] = {"1": "m", "2": "ft"}


def _recognises(text: str) -> bool:
    return text.lstrip(_MARKS).startswith("00NMSDR")


def _guess(text: str, source: str) -> Guess:
    head = text.lstrip(_MARKS).splitlines()[0]
    if not head.startswith("00NMSDR33"):
        refuse(source, f"{head[4:12].strip()} has columns of another width; export the job as SDR33", 1)
    found = _UNITS.search(head)
    if found is None:
        refuse(source, "the header does not tell the units: six digits at its end", 1)
    if found["angle"] not in "12" or found["length"] not in _LENGTHS:
        refuse(source, "angles in mil or distances in US feet: set the instrument to degrees or gon, and metres", 1)
    columns = ColumnMap(
        format=FORMAT.name,
        length_unit=_LENGTHS[found["length"]],
        angle_unit="gon" if found["angle"] == "2" else "deg",
    )
    fixes = _read(text, columns, source)
    return Guess(columns, (f"{len(fixes)} points; the header says {columns.length_unit} and {columns.angle_unit}",))


def _read(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    mm, rad = MM_PER[columns.length_unit], RAD_PER[columns.angle_unit]
    fixes: list[ExportedFix] = []
    origin, job, station = (0.0, 0.0, 0.0), "", ""
    stood = {station: origin}
    times_set_up, has_measured = 0, True  # since it was set up
    target_mm = 0.0
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        record = line.strip("\x02\x03\x04\x1a\r\n ")
        if not record or record.isdigit():
            continue
        code, cells = record[:_CODE], _cells(record)
        if has_measured and code[:2] in _SETS_UP:
            times_set_up, has_measured = times_set_up + 1, False
        match code[:2]:
            case "10":
                job = _name(cells, 0)
            case "02":
                north, east, up, height = (_number(cells, n, code, number, source) * mm for n in (1, 2, 3, 4))
                origin, station = (east, north, up + height), _station(job, _name(cells, 0))
                if stood.setdefault(station, origin) != origin and any(fix.station == station for fix in fixes):
                    problem = f"a second place of the station {station!r}; name it otherwise, or split the file"
                    refuse(source, f"{problem}, one set-up each", number)
                stood[station] = origin
            case "03":
                target_mm = _number([record[_CODE:]], 0, code, number, source) * mm
            case "08":
                north, east, up = (_number(cells, n, code, number, source) * mm for n in (1, 2, 3))
                place = (east - origin[0], north - origin[1], up + target_mm - origin[2])
                fix = ExportedFix(number, _name(cells, 0), _name(cells, 4), place)
                fixes.append(replace(fix, station=station, times_set_up=times_set_up))
                has_measured = True
            case "09" if code in ("09F1", "09F2"):
                distance, zenith, hz = (_number(cells, n, code, number, source) for n in (2, 3, 4))
                place = polar_position_mm(hz * rad, zenith * rad, distance * mm)
                at = _station(job, _name(cells, 0)) if _name(cells, 0) else station
                fix = ExportedFix(number, _name(cells, 1), _name(cells, 5), place)
                fixes.append(replace(fix, station=at, times_set_up=times_set_up))
                has_measured = True
            case kind if kind not in _PASSED_OVER | _SETS_UP:
                refuse(source, f"records {code!r} are not known", number)
    if not fixes:
        refuse(source, "the file has no measured point (records 08 or 09F1)")
    return fixes


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
    return value


FORMAT = ExportFormat(
    name="sokkia_sdr", title="Sokkia SDR33", rank=20, recognises=_recognises, guess=_guess, read=_read
)
