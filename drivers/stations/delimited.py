"""Tables of text: their separator, header, units and columns are guessed, and they are read by the map that results."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime

from drivers.stations.export_format import (
    MM_PER,
    RAD_PER,
    AngleUnit,
    ColumnMap,
    ExportedFix,
    ExportFormat,
    Guess,
    LengthUnit,
    Role,
    polar_position_mm,
    refuse,
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
_SEPARATORS = (";", "\t", ",", " ")
_HEAD_LINES = 200  # a preamble is not longer
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_LENGTH_WORDS: dict[str, LengthUnit] = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("cm", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("in", "inch", "inches"), "in"),
    **dict.fromkeys(("ft", "feet", "foot"), "ft"),
}
_ANGLE_WORDS: dict[str, AngleUnit] = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("gon", "gons", "grad", "grads"), "gon"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
}
_UNIT = re.compile(r"[\[(]\s*+([^\[\]()\s][^\[\]()]*+)[\])]|_(mm|cm|m|in|ft|deg|gon|rad)$")
_BEFORE_UNIT = re.compile(r"(?<!\s)\s++(?=[\[(])")  # blanks between a name and its unit
_FEW_STATIONS = 2  # may have a row each
_OWN_VALUES = 0.8  # share of rows with a value of their own beyond which a column names no set-ups
_LARGEST = 1e12  # of coordinates, angles and seconds in any unit
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_TWO_MEANINGS = (
    "{} cells where {} are due: commas separate columns and are decimal signs as well; export with decimal points, or "
    "with semicolons between columns"
)
_TIME_FORMATS = ("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S")
_CLOCK_FORMATS = ("%H:%M:%S.%f", "%H:%M:%S")


def delimited_format(name: str, title: str, rank: int, recognises: Callable[[str], bool]) -> ExportFormat:
    """Return a format of tables with one point a line."""

    def guess(text: str, source: str) -> Guess:
        return guess_table(text, source, name)

    return ExportFormat(name=name, title=title, rank=rank, recognises=recognises, guess=guess, read=read_table)


def lines_of(text: str) -> list[str]:
    """Return the lines of a text."""
    return text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")


def line_at(lines: list[str], number: int, source: str) -> str:
    """Return the line of a number from 1, which a map names.

    Raises:
        DescriptionError: the file is shorter.
    """
    if number > len(lines):
        refuse(source, f"the map's header is in line {number}, the file has {len(lines)}; is the map of another file?")
    return lines[number - 1]


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    if separator == " ":
        return _BEFORE_UNIT.sub("", line).split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field of more characters than any that means something
        return []


def number_of(cell: str, decimal: str) -> float | None:
    """Return the number in a cell; None where there is none, or one beyond what any instrument measures."""
    if not _NUMBER.fullmatch(cell) or (decimal == "." and "," in cell):
        return None
    value = float(cell.replace(",", "."))
    return value if abs(value) < _LARGEST else None


def why_no_number(cell: str) -> str:
    """Return what is wrong with a cell that `number_of` finds no number in."""
    is_too_large = _NUMBER.fullmatch(cell) and number_of(cell, ",") is None
    return f"{cell!r} is {'beyond what any instrument measures' if is_too_large else 'not a number'}"


def decimal_of(cells: Iterable[str]) -> str:
    """Return the sign before fractions: a comma where it is in numbers, between quotes if it separates them too."""
    return "," if any("," in cell and _NUMBER.fullmatch(cell) for cell in cells) else "."


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


def _roles(cells: list[str]) -> dict[Role, str]:
    """Return the roles of a header's cells, each by the first that has it."""
    roles: dict[Role, str] = {}
    for cell in cells:
        plain = re.sub(r"[\W_]", "", _UNIT.sub("", cell.lower()))
        for role, words in SYNONYMS.items():
            if plain in words:
                roles.setdefault(role, cell)
    return roles


def _with_header(
    lines: list[str], separator: str, header: int, roles: dict[Role, str], name: str, source: str
) -> Guess:
    cells = cells_of(lines[header - 1], separator)
    notes = [f"line {header} is the header; columns are separated by {_said(separator)}"]
    first = header + 1
    while first < len(lines) and not any(map(str.isdigit, lines[first - 1])):
        first += 1  # a line of units, an empty one
    sample = [cells_of(line, separator) for line in lines[first - 1 : first + 200] if line.strip()]
    decimal = decimal_of(cell for row in sample for cell in row)
    if {"x", "y", "z"} <= roles.keys():
        roles = {role: cell for role, cell in roles.items() if role not in ("hz", "zenith", "distance")}
    else:
        roles = {role: cell for role, cell in roles.items() if role not in ("x", "y", "z")}
    by_role = ", ".join(f"{role}: {cell!r}" for role, cell in roles.items())
    notes.append(f"columns by their names: {by_role}")
    if "point" not in roles:
        notes.append("no column is known to name the points, so they are 1, 2, ... in the order of the file")
    stations = [cell for cell in cells if "station" in _roles([cell])]
    if len(stations) > 1:
        notes.append(f"set-ups by {stations[0]!r} alone, though columns {', '.join(stations)} may name them")
    measured = [roles[role] for role in ("x", "y", "z", "distance") if role in roles]
    units_line = cells_of(lines[header], separator) if first > header + 1 else []
    length = _unit(measured, cells, units_line, lines[: header - 1], _LENGTH_WORDS, source)
    if length is None:
        places = [cells.index(cell) for cell in measured]
        values = [number_of(row[p], decimal) for row in sample for p in places if p < len(row)]
        largest = max((abs(value) for value in values if value is not None), default=0.0)
        length = "m" if largest < 200 else "mm"
        notes.append(f"no unit of length is named; {largest:g} is the greatest number, so {length} is taken")
    angles = [roles[role] for role in ("hz", "zenith") if role in roles]
    angle = _unit(angles, cells, units_line, lines[: header - 1], _ANGLE_WORDS, source)
    if angles and angle is None:
        values = [
            number_of(row[cells.index(a)], decimal) for row in sample for a in angles if cells.index(a) < len(row)
        ]
        largest = max((abs(value) for value in values if value is not None), default=0.0)
        angle = "rad" if largest <= math.tau else "deg" if largest <= 360.0 else "gon"  # a zenith angle is near 90 deg
        notes.append(f"no unit of angles is named; {largest:g} is the greatest number, so {angle} is taken")
    time_format = _time_format(sample, cells, roles, notes)
    found = ColumnMap.model_validate(
        {
            "format": name,
            "separator": separator,
            "decimal": decimal,
            "header_line": header,
            "first_line": first,
            "length_unit": length,
            "angle_unit": angle or "deg",
            "time_format": time_format,
            "columns": roles,
        }
    )
    return Guess(found, tuple(notes))


def _without_header(lines: list[str], source: str, name: str) -> Guess:
    for separator in _SEPARATORS:
        for number, line in enumerate(lines[:_HEAD_LINES], 1):
            cells = cells_of(line, separator)
            decimal = decimal_of(cells)
            numbers = [place for place, cell in enumerate(cells, 1) if number_of(cell, decimal) is not None]
            if len(cells) >= 4 and len(numbers) >= 3 and {2, 3, 4} <= set(numbers):
                _check_without_header(lines, separator, number, source)
                sample = [cells_of(each, separator) for each in lines[number - 1 : number + 200] if each.strip()]
                values = [number_of(cell, decimal) for row in sample for cell in row[1:4]]
                largest = max((abs(value) for value in values if value is not None), default=0.0)
                length = "m" if largest < 200 else "mm"
                notes = (
                    f"no header; from line {number} on: point, x, y, z, separated by {_said(separator)}",
                    f"{largest:g} is the greatest coordinate, so {length} is taken",
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
    """Refuse a header that nothing is known of, and commas that are separator and decimal sign in one."""
    cells = cells_of(lines[first - 1], separator)
    for number, line in enumerate(lines[: first - 1], 1):
        names = cells_of(line, separator)
        if len(names) == len(cells) and not any(number_of(name, ",") is not None for name in names):
            said = f"its names are not known ({', '.join(names)})"
            refuse(source, f"this is a header, and {said}; call the columns point, x, y and z in it", number)
    if separator == "," and len(cells) >= 7 and all(map(_WHOLE.fullmatch, cells[1:7])):
        refuse(source, _TWO_MEANINGS.format(len(cells), 4), first)


def _unit(
    of: list[str],
    header: list[str],
    units_line: list[str],
    preamble: list[str],
    words: Mapping[str, str],
    source: str,
) -> str | None:
    """Return the unit of some columns: from their names, the line below the header, or a line before it."""
    units: dict[str, str] = {}  # unit -> the first column that has it
    for cell in of:
        found = _UNIT.search(cell.lower())
        place = header.index(cell)
        below = units_line[place].lower() if place < len(units_line) else ""
        for word in ((found[1] or found[2]) if found else "", below):
            if word and word.strip("[]() ") in words:
                units.setdefault(words[word.strip("[]() ")], cell)
                break
    if len(units) > 1:
        said = " and ".join(f"{cell!r} in {unit}" for unit, cell in units.items())
        refuse(source, f"the columns have different units, {said}; export them in one unit")
    if units:
        return next(iter(units))
    for line in preamble:
        if "unit" in line.lower():
            for word in re.findall(r"[a-z°]+", line.lower()):
                if word in words:
                    return words[word]
    return None


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
    for number, line in enumerate(lines[columns.first_line - 1 :], columns.first_line):
        if not line.strip():
            continue
        cells = cells_of(line, columns.separator)
        if header and any(cells[len(header) :]):
            reason = f"{len(cells)} cells where the header has {len(header)}"
            refuse(
                source, _TWO_MEANINGS.format(len(cells), len(header)) if columns.separator == "," else reason, number
            )

        def number_at(role: Role, cells: list[str] = cells, number: int = number) -> float:
            cell = _cell(cells, places[role], columns.columns[role], number, source)
            value = number_of(cell, columns.decimal)
            if value is None:
                said = why_no_number(cell) if cell else "the cell is empty; leave out lines without a measurement"
                refuse(source, said, number, columns.columns[role])
            return value

        def text_at(role: Role, cells: list[str] = cells) -> str:
            return cells[places[role]] if role in places and places[role] < len(cells) else ""

        mm = MM_PER[columns.length_unit]
        if is_polar:
            rad = RAD_PER[columns.angle_unit]
            place = polar_position_mm(number_at("hz") * rad, number_at("zenith") * rad, number_at("distance") * mm)
        else:
            place = (number_at("x") * mm, number_at("y") * mm, number_at("z") * mm)
        constant = number_of(text_at("prism_constant"), columns.decimal)  # for a note alone: anything may stand there
        constant_mm = None if constant is None else constant * _named_mm(places["prism_constant"], header)
        point = text_at("point") or str(len(fixes) + 1)
        time_s = _time_s(" ".join(filter(None, (text_at("date"), text_at("time")))), columns, number, source)
        station = text_at("station")
        fixes.append(
            ExportedFix(number, point, text_at("prism"), place, time_s, station, prism_constant_mm=constant_mm)
        )
    if not fixes:
        refuse(source, "no points below the header")
    if "station" in places:
        _check_stations(fixes, columns, source)
    return fixes


def _named_mm(place: int, header: list[str]) -> float:
    """Return the millimetres of a unit that the header of a column names; 1 where it names none."""
    found = _UNIT.search(header[place].lower()) if place < len(header) else None
    return MM_PER[_LENGTH_WORDS.get((found[1] or found[2]).strip(), "mm")] if found else 1.0


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


def _time_s(text: str, columns: ColumnMap, line: int, source: str) -> float | None:
    """Return seconds: of a number as it is, of a date since 1970, of a time of day since midnight."""
    if not text or "time" not in columns.columns:
        return None
    value = number_of(text, columns.decimal)
    if value is not None:
        return value
    try:
        form = columns.time_format
        found = datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        said = columns.time_format or "seconds, or an ISO time"
        refuse(source, f"{text!r} is not a time of the form {said}", line, columns.columns["time"])
    if columns.time_format in _CLOCK_FORMATS:
        return found.hour * 3600.0 + found.minute * 60.0 + found.second + found.microsecond / 1e6
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
