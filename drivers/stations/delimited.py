"""Tables of text: their separator, header, units and columns are guessed, and they are read by the map that results."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime

from drivers.stations.cells import WHOLE, Numbers, cells_of, decimal_of, line_at, lines_of, number_of, why_too_many
from drivers.stations.export_format import (
    MM_PER,
    RAD_PER,
    ColumnMap,
    ExportedFix,
    ExportFormat,
    Guess,
    Role,
    polar_position_mm,
    refuse,
)
from drivers.stations.named_units import (
    ANGLES,
    LENGTHS,
    bracket_words,
    check_seconds,
    mm_of,
    unit_of_columns,
    unit_of_preamble,
    without_unit,
)

_NAMES: Mapping[Role, str] = {
    "point": "point pointname pointid pointnumber pointno ptid ptno pt name id label no nr pose punkt punktnr "
    "punktnummer ptnr",
    "x": "x east easting e xcoordinate xactual actualx measuredx xmeasured rechtswert",
    "y": "y north northing n ycoordinate yactual actualy measuredy ymeasured hochwert",
    "z": "z height elevation elev up orthoheight zcoordinate zactual actualz measuredz zmeasured höhe hoehe",
    "hz": "hz hzangle horizontalangle hangle azimuth hzcircle",
    "zenith": "v vz zenith zenithangle verticalangle vangle vcircle",
    "distance": "sd slopedistance slopedist distance range d",
    "prism": "prism code target reflector marker",
    "prism_constant": "prismconstant prismconst prismoffset reflectorconstant reflectorconst prismenkonstante "
    "additionskonstante",
    "station": "station stationname stationid stationno stationnr stn setup setupname setupid setupno standpunkt "
    "standpunktnr instrumentstation",
    "date": "date measurementdate",
    "time": "time datetime timestamp dateandtime measurementtime times utc",
}
SYNONYMS: Mapping[Role, frozenset[str]] = {role: frozenset(words.split()) for role, words in _NAMES.items()}
_CARTESIAN: tuple[Role, ...] = ("x", "y", "z")
_POLAR: tuple[Role, ...] = ("hz", "zenith", "distance")
_SEPARATORS = (";", "\t", ",", " ")
_HEAD_LINES = 200  # a preamble is not longer
_FEW_STATIONS = 2  # may have a row each
_OWN_VALUES = 0.8  # share of rows with a value of their own beyond which a column names no set-ups
_TIME_FORMATS = ("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S")
_CLOCK_FORMATS = ("%H:%M:%S.%f", "%H:%M:%S")


def delimited_format(name: str, title: str, rank: int, recognises: Callable[[str], bool]) -> ExportFormat:
    """Return a format of tables with one point a line."""

    def guess(text: str, source: str) -> Guess:
        return guess_table(text, source, name)

    return ExportFormat(name=name, title=title, rank=rank, recognises=recognises, guess=guess, read=read_table)


# ---- the map ---------------------------------------------------------------------------------------------------------


def guess_table(text: str, source: str, name: str) -> Guess:
    """Guess how a table is read.

    Args:
        text: the file's.
        source: its name, for messages.
        name: of the format.

    Raises:
        DescriptionError: no line names coordinates, or angles and a distance, and none has four numbers.
    """
    lines = lines_of(text)
    for separator in _SEPARATORS:
        for number, line in enumerate(lines[:_HEAD_LINES], 1):
            roles = _roles(cells_of(line, separator))
            if {"x", "y", "z"} <= roles.keys() or {"hz", "zenith", "distance"} <= roles.keys():
                if separator == " " and any(
                    cell[-1] in ",;" for cell in lines[number : number + 1] for cell in cell.split()
                ):
                    continue  # a remark that names the columns; the rows are separated otherwise
                return _with_header(lines, separator, number, roles, name, source)
    return _without_header(lines, source, name)


def _roles(cells: list[str]) -> dict[Role, list[str]]:
    """Return the cells of a header that may have each role: by their names, and coordinates by remarks on them too."""
    roles: dict[Role, list[str]] = {}
    for cell in cells:
        own = _roles_of(without_unit(cell))
        for remark in bracket_words(cell) if set(own) & {*_CARTESIAN, *_POLAR} else []:
            own += [role for role in _roles_of(remark.lower()) if role not in own]
        for role in own:
            roles.setdefault(role, []).append(cell)
    return roles


def _roles_of(name: str) -> list[Role]:
    plain = re.sub(r"(?!^-)[\W_]", "", name)  # -Z points down
    return [role for role, words in SYNONYMS.items() if plain in words]


def _one_of_each(found: dict[Role, list[str]], header_line: int, source: str, notes: list[str]) -> dict[Role, str]:
    """Return the column of each role, coordinates before angles; a second one that may be measured is refused."""
    left_out = _POLAR if found.keys() >= set(_CARTESIAN) else _CARTESIAN
    roles: dict[Role, str] = {}
    for role, cells in found.items():
        if role in left_out:
            continue
        if len(cells) > 1 and role in (*_CARTESIAN, *_POLAR):
            said = " and ".join(map(repr, cells))
            todo = f"rename one, or write a map that names the right one ({role} in [columns]) and give it with --map"
            refuse(source, f"columns {said} may both be {role}; {todo}", header_line)
        roles[role] = cells[0]
        if len(cells) > 1:
            notes.append(f"{role} by {cells[0]!r} alone, though columns {', '.join(cells)} may be it")
    return roles


def _with_header(
    lines: list[str], separator: str, header: int, found: dict[Role, list[str]], name: str, source: str
) -> Guess:
    cells = cells_of(lines[header - 1], separator)
    notes = [f"line {header} is the header; columns are separated by {_said(separator)}"]
    first = header + 1
    while first < len(lines) and not any(map(str.isdigit, lines[first - 1])):
        first += 1  # a line of units, an empty one
    roles = _one_of_each(found, header, source, notes)
    by_role = ", ".join(f"{role}: {cell!r}" for role, cell in roles.items())
    notes.insert(1, f"columns by their names: {by_role}")
    if "point" not in roles:
        notes.append("no column is known to name the points, so they are 1, 2, ... in the order of the file")
    sample = [cells_of(line, separator) for line in lines[first - 1 : first + 200] if line.strip()]

    def sampled(of: list[str]) -> list[str]:
        places = [cells.index(cell) for cell in of]
        return [row[place] for row in sample for place in places if place < len(row)]

    lengths = [roles[role] for role in (*_CARTESIAN, "distance") if role in roles]
    angles = [roles[role] for role in ("hz", "zenith") if role in roles]
    numbers = sampled([*lengths, *angles, *(roles[role] for role in ("time", "prism_constant") if role in roles)])
    decimal = decimal_of(numbers)
    notes += _decimal_note(numbers)
    if "time" in roles:
        check_seconds(roles["time"], header, source)
    units_line = next((at for at in range(header + 1, first) if lines[at - 1].strip()), 0)
    units = cells_of(lines[units_line - 1], separator) if units_line else []
    given: dict[str, str] = {}
    for key, quantity, of, by_size in (
        ("length_unit", LENGTHS, lengths, _length_by_size),
        ("angle_unit", ANGLES, angles, _angle_by_size),
    ):
        if not of:
            continue
        places = [cells.index(cell) for cell in of]
        below = [units[place] if place < len(units) else "" for place in places]
        named = unit_of_columns(quantity, header, of, units_line, below, source)
        named = named or unit_of_preamble(quantity, lines[: header - 1], source)
        if named is None:
            largest = _largest(sampled(of), decimal)
            given[key] = by_size(largest)
            greatest = f"{largest:g} is the greatest number, so {given[key]} is taken"
            notes.append(f"no unit of {quantity.name} is named that is known; {greatest}")
        else:
            given[key] = named[0]
            notes.append(f"the unit of {quantity.name} is {named[0]}, as {named[1]} says")
    map_ = ColumnMap.model_validate(
        {
            "format": name,
            "separator": separator,
            "decimal": decimal,
            "header_line": header,
            "first_line": first,
            "time_format": _time_format(sample, cells, roles, notes),
            "columns": roles,
            **given,
        }
    )
    return Guess(map_, tuple(notes))


def _decimal_note(cells: list[str]) -> tuple[str, ...]:
    comma = next((cell for cell in cells if decimal_of([cell]) == ","), None)
    return () if comma is None else (f"commas are decimal signs, as in {comma!r}",)


def _largest(cells: list[str], decimal: str) -> float:
    values = [number_of(cell, decimal) for cell in cells]
    return max((abs(value) for value in values if value is not None), default=0.0)


def _length_by_size(largest: float) -> str:
    return "m" if largest < 200 else "mm"


def _angle_by_size(largest: float) -> str:
    return "rad" if largest <= math.tau else "deg" if largest <= 360.0 else "gon"  # a zenith angle is near 90 deg


def _without_header(lines: list[str], source: str, name: str) -> Guess:
    for separator in _SEPARATORS:
        for number, line in enumerate(lines[:_HEAD_LINES], 1):
            cells = cells_of(line, separator)
            decimal = decimal_of(cells[1:4])
            numbers = [place for place, cell in enumerate(cells, 1) if number_of(cell, decimal) is not None]
            if len(cells) >= 4 and len(numbers) >= 3 and {2, 3, 4} <= set(numbers):
                _check_without_header(lines, separator, number, source)
                sample = [cells_of(each, separator) for each in lines[number - 1 : number + 200] if each.strip()]
                coordinates = [cell for row in sample for cell in row[1:4]]
                largest = _largest(coordinates, decimal)
                named = unit_of_preamble(LENGTHS, lines[: number - 1], source)
                length = named[0] if named else _length_by_size(largest)
                why = f"{named[1]} says" if named else f"{largest:g} is the greatest coordinate"
                notes = (
                    f"no header; from line {number} on: point, x, y, z, separated by {_said(separator)}",
                    *_decimal_note(coordinates),
                    f"the unit of length is {length}, as {why}",
                )
                columns = {"point": 1, "x": 2, "y": 3, "z": 4}
                given = {"format": name, "separator": separator, "decimal": decimal, "first_line": number}
                return Guess(ColumnMap.model_validate({**given, "length_unit": length, "columns": columns}), notes)
    refuse(
        source,
        "no line names columns x, y, z (or hz, v and a slope distance), none begins with a point and three numbers; "
        "write a map and give it with --map",
    )


def _check_without_header(lines: list[str], separator: str, first: int, source: str) -> None:
    """Refuse a header that is not known, a damaged row, and commas that are separator and decimal sign in one."""
    cells = cells_of(lines[first - 1], separator)
    for number, line in enumerate(lines[: first - 1], 1):
        before = cells_of(line, separator)
        numbers = sum(number_of(cell, ",") is not None for cell in before)
        if len(before) == len(cells) and any(before[1:]) and not numbers:
            said = f"its names are not known ({', '.join(before)})"
            refuse(source, f"this is a header, and {said}; call the columns point, x, y and z in it", number)
        if numbers > (0 if len(before) == len(cells) else 1):
            said = f"it has numbers, as the points from line {first} on, but is no point, x, y, z"
            refuse(source, f"{said}; mend it, or delete it if it is a remark", number)
    if separator == "," and len(cells) >= 7 and all(map(WHOLE.fullmatch, cells[1:7])):
        refuse(source, why_too_many(cells, 4, separator), first)


def _time_format(sample: list[list[str]], header: list[str], roles: dict[Role, str], notes: list[str]) -> str:
    if "time" not in roles or not sample:
        return ""
    text = _time_text(sample[0], header, roles)
    for known in (*_TIME_FORMATS, *_CLOCK_FORMATS):
        try:
            datetime.strptime(text, known)
        except ValueError:
            continue
        notes.append(f"times such as {text!r} are read as {known}")
        return known
    return ""


def _said(separator: str) -> str:
    return {";": "semicolons", "\t": "tabulators", ",": "commas", " ": "blanks"}[separator]


# ---- the rows --------------------------------------------------------------------------------------------------------


def read_table(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    """Read a table, one point a line.

    Raises:
        DescriptionError: a column is missing, or a cell is no number; with file, line, column and reason.
    """
    lines = lines_of(text)
    at = columns.header_line
    header = cells_of(line_at(lines, at, source), columns.separator) if at else []
    places = {role: _place(column, header, columns.header_line, source) for role, column in columns.columns.items()}
    is_polar = {"hz", "zenith", "distance"} <= places.keys()
    if not is_polar and not {"x", "y", "z"} <= places.keys():
        refuse(source, "the map names neither x, y, z nor hz, zenith, distance")
    fixes: list[ExportedFix] = []
    numbers = Numbers(columns.decimal, source)
    due = len(header)
    for number, line in enumerate(lines[columns.first_line - 1 :], columns.first_line):
        if not line.strip():
            continue
        cells = cells_of(line, columns.separator)
        due = due or len(cells)
        if columns.separator == " " and len(cells) != due:
            said = f"{len(cells)} cells where the {'header has' if header else 'rows before have'} {due}"
            todo = "an empty one between blanks cannot be told; fill it in, or separate columns otherwise"
            refuse(source, f"{said}; {todo}", number)
        if header and any(cells[len(header) :]):
            refuse(source, why_too_many(cells, len(header), columns.separator), number)

        def number_at(role: Role, cells: list[str] = cells, number: int = number) -> float:
            cell = _cell(cells, places[role], columns.columns[role], number, source)
            return numbers.read(cell, number, columns.columns[role])

        def text_at(role: Role, cells: list[str] = cells) -> str:
            return cells[places[role]] if role in places and places[role] < len(cells) else ""

        mm = MM_PER[columns.length_unit]
        if is_polar:
            rad = RAD_PER[columns.angle_unit]
            place = polar_position_mm(number_at("hz") * rad, number_at("zenith") * rad, number_at("distance") * mm)
        else:
            place = (number_at("x") * mm, number_at("y") * mm, number_at("z") * mm)
        constant = number_of(text_at("prism_constant"), columns.decimal)  # for a note alone: anything may stand there
        constant_mm = None if constant is None else constant * mm_of("".join(header[places["prism_constant"] :][:1]))
        point = text_at("point") or str(len(fixes) + 1)
        time_s = _time_s(" ".join(filter(None, (text_at("date"), text_at("time")))), columns, numbers, number)
        station = text_at("station")
        fixes.append(
            ExportedFix(number, point, text_at("prism"), place, time_s, station, prism_constant_mm=constant_mm)
        )
    if not fixes:
        refuse(source, "no points below the header")
    if "station" in places:
        _check_stations(fixes, columns, source)
    return fixes


def _check_stations(fixes: list[ExportedFix], columns: ColumnMap, source: str) -> None:
    """Refuse a column of stations that some rows leave open, or that says another thing in nearly every row.

    An empty cell may mean the station above it, or none; chainages and points' names differ from row to row.
    """
    found = {fix.station for fix in fixes}
    if "" in found and len(found) > 1:
        line = next(fix.line for fix in fixes if not fix.station)
        refuse(source, "names no station, as other rows do; fill it in", line, columns.columns["station"])
    if len(found) > max(_FEW_STATIONS, _OWN_VALUES * len(fixes)):
        said = f"{len(found)} different values in {len(fixes)} rows, so it does not name set-ups"
        reason = f"{said}; call the column otherwise ('point' if it names points), or leave station out of a map"
        refuse(source, reason, columns.header_line or None, columns.columns["station"])


def _place(column: str | int, header: list[str], header_line: int, source: str) -> int:
    if isinstance(column, int):
        if column < 1:
            refuse(source, "columns of the map are counted from 1", None, column)
        return column - 1
    if header.count(column) != 1:
        problem = "is not in the header" if column not in header else "is in the header twice; give its number"
        refuse(source, f"the column of the map {problem}; there are {', '.join(header)}", header_line or None, column)
    return header.index(column)


def _cell(cells: list[str], place: int, column: str | int, line: int, source: str) -> str:
    if place >= len(cells):
        refuse(source, f"the line has {len(cells)} columns only", line, column)
    return cells[place]


def _time_text(cells: list[str], header: list[str], roles: Mapping[Role, str]) -> str:
    places = [header.index(roles[role]) for role in ("date", "time") if role in roles]
    return " ".join(cells[place] for place in places if place < len(cells))


def _time_s(text: str, columns: ColumnMap, numbers: Numbers, line: int) -> float | None:
    """Return seconds: of a number as it is, of a date since 1970, of a time of day since midnight."""
    if not text or "time" not in columns.columns:
        return None
    value = numbers.find(text, line)
    if value is not None:
        return value
    try:
        form = columns.time_format
        found = datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        said = columns.time_format or "seconds, or an ISO time"
        refuse(numbers.source, f"{text!r} is not a time of the form {said}", line, columns.columns["time"])
    if columns.time_format in _CLOCK_FORMATS:
        return found.hour * 3600.0 + found.minute * 60.0 + found.second + found.microsecond / 1e6
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
