"""Text tables with one point per line, read according to a map."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import NoReturn

from drivers.stations.export_format import (
    MM_PER,
    RAD_PER,
    ColumnMap,
    ExportedFix,
    ExportFormat,
    Guess,
    Role,
    measured_mm,
    polar_position_mm,
    refuse,
)
from drivers.stations.tables.cells import (
    Numbers,
    cells_of,
    is_no_row,
    line_at,
    lines_of,
    number_of,
    why_too_few,
    why_too_many,
)
from drivers.stations.tables.columns import CARTESIAN, POLAR
from drivers.stations.tables.guess import CLOCK_FORMATS, guess_table
from drivers.stations.tables.named_units import mm_of

_FEW_STATIONS = 2  # so few different values always count as set-ups, even with one row each
_OWN_VALUES = 0.8  # a column with more different values than this share of the rows does not name set-ups
_SLACK_RAD = 1e-6  # tolerance for rounded angles


def delimited_format(name: str, title: str, rank: int, recognises: Callable[[str], bool]) -> ExportFormat:
    """Return a format of tables with one point per line.

    Args:
        name: name of the format in maps.
        title: name of the format for people.
        rank: formats with a lower rank are tried first.
        recognises: returns True for a text of this format.
    """

    def guess(text: str, source: str) -> Guess:
        return guess_table(text, source, name)

    return ExportFormat(name=name, title=title, rank=rank, recognises=recognises, guess=guess, read=read_table)


def read_table(text: str, columns: ColumnMap, source: str) -> list[ExportedFix]:
    """Read a table with one point per line.

    Args:
        text: content of the file.
        columns: map of its columns.
        source: name of the file, for error messages.

    Raises:
        DescriptionError: a column is missing, or a cell is not a number; the message gives file, line, column and
            reason.
    """
    lines = lines_of(text)
    at = columns.header_line
    header = cells_of(line_at(lines, at, source), columns.separator) if at else []
    places = {role: _place(column, header, columns.header_line, source) for role, column in columns.columns.items()}
    is_polar = places.keys() >= set(POLAR)
    if not is_polar and not places.keys() >= set(CARTESIAN):
        refuse(source, "the map names neither x, y, z nor hz, zenith, distance")
    fixes: list[ExportedFix] = []
    numbers = Numbers(columns.decimal, source)
    zeniths: dict[int, float] = {}  # line -> rad
    measured = [places[role] for role in (POLAR if is_polar else CARTESIAN)]
    for number, cells in _rows(lines, columns, header, measured, source):

        def number_at(role: Role, cells: list[str] = cells, number: int = number) -> float:
            cell = _cell(cells, places[role], columns.columns[role], number, source)
            return numbers.read(cell, number, columns.columns[role])

        def text_at(role: Role, cells: list[str] = cells) -> str:
            return cells[places[role]] if role in places and places[role] < len(cells) else ""

        mm = MM_PER[columns.length_unit]
        if is_polar:
            rad = RAD_PER[columns.angle_unit]
            zeniths[number] = number_at("zenith") * rad
            place = polar_position_mm(
                number_at("hz") * rad, zeniths[number], number_at("distance") * mm, source, number
            )
        else:
            place = measured_mm((number_at("x") * mm, number_at("y") * mm, number_at("z") * mm), source, number)

        def unit_at(role: Role, otherwise_mm: float) -> float:
            return mm_of("".join(header[places[role] :][:1]), otherwise_mm)

        constant = number_of(text_at("prism_constant"), columns.decimal)  # only for a note, so any content is accepted
        constant_mm = None if constant is None else constant * unit_at("prism_constant", 1.0)
        is_below = not is_polar and text_at("target_height") != ""
        height_mm = number_at("target_height") * unit_at("target_height", mm) if is_below else None

        time_s, has_zone = _time(" ".join(filter(None, (text_at("date"), text_at("time")))), columns, numbers, number)
        fixes.append(
            ExportedFix(
                number,
                text_at("point") or str(len(fixes) + 1),
                text_at("prism"),
                place,
                time_s,
                text_at("station"),
                prism_constant_mm=constant_mm,
                target_height_mm=height_mm,
                is_numbered=not text_at("point"),
                has_zone=has_zone,
            )
        )
    if not fixes:
        refuse(source, "there are no points below the header")
    if is_polar:
        _check_zeniths(zeniths, columns, source)
    if len({fix.target_height_mm for fix in fixes}) > 1:
        _refuse_target_heights(fixes, columns, source)
    if "station" in places:
        _check_stations(fixes, columns, source)
    return fixes


def _rows(
    lines: list[str], columns: ColumnMap, header: list[str], measured: list[int], source: str
) -> list[tuple[int, list[str]]]:
    """Return the line number and the cells of each row; empty rows and comments (#) are skipped.

    Every row must have a cell for each name in the header, or without a header for each cell of the first row; empty
    names or cells at the end do not count. All rows may be shorter than the header by the same number of cells, because
    a spreadsheet leaves out empty columns.
    """
    rows = []
    for number, line in enumerate(lines[columns.first_line - 1 :], columns.first_line):
        cells = cells_of(line, columns.separator)
        if not is_no_row(line, columns.separator):
            rows.append((number, cells))
        elif all(place < len(cells) and number_of(cells[place], columns.decimal) is not None for place in measured):
            refuse(
                source,
                "# begins a comment, but this may be a point: delete the line, or rename the point",
                number,
            )
    first = header or (rows[0][1] if rows else [])
    most, least = len(first), max((place for place, cell in enumerate(first, 1) if cell), default=0)
    counts = {len(cells) for _, cells in rows}
    if header and columns.separator != " " and len(rows) > 1 and len(counts) == 1:
        least = min(least, *counts)
    for number, cells in rows:
        if any(cells[most:]):
            refuse(source, why_too_many(cells, most, columns.separator), number)
        if len(cells) < least:
            refuse(source, why_too_few(cells, most, columns.separator), number)
    return rows


def _check_zeniths(zeniths: Mapping[int, float], columns: ColumnMap, source: str) -> None:
    """Refuse zenith angles that are out of range or look like angles from the horizon."""
    todo = "from the zenith (90 deg or 100 gon is level); export zenith angles"
    for line, zenith in zeniths.items():
        if not -_SLACK_RAD <= zenith <= math.tau + _SLACK_RAD:
            said = f"below 0 or above a full circle in {columns.angle_unit}, so it is not an angle"
            refuse(source, f"{said} {todo}", line, columns.columns["zenith"])
    if all(min(zenith, math.tau - zenith) < math.pi / 4 for zenith in zeniths.values()):
        said = "all angles are within 45 deg of 0, so they look like angles from the horizon, not"
        refuse(source, f"{said} {todo}", min(zeniths), columns.columns["zenith"])


def _refuse_target_heights(fixes: list[ExportedFix], columns: ColumnMap, source: str) -> NoReturn:
    first = fixes[0].target_height_mm
    line = next(fix.line for fix in fixes if fix.target_height_mm != first)
    said = f"the target height differs from line {fixes[0].line}, so coordinates are of places at different heights"
    todo = "export with target heights of 0, or one file for each height"
    refuse(source, f"{said} below the prism; {todo}", line, columns.columns["target_height"])


def _check_stations(fixes: list[ExportedFix], columns: ColumnMap, source: str) -> None:
    """Refuse a column of stations that is empty in some rows or has a different value in nearly every row.

    An empty cell could mean the station above it or none. Chainages and point names differ from row to row.
    """
    found = {fix.station for fix in fixes}
    if "" in found and len(found) > 1:
        line = next(fix.line for fix in fixes if not fix.station)
        refuse(source, "the station is missing, but not in other rows; fill it in", line, columns.columns["station"])
    if len(found) > max(_FEW_STATIONS, _OWN_VALUES * len(fixes)):
        said = f"{len(found)} different values in {len(fixes)} rows, so it does not name set-ups"
        reason = f"{said}; rename the column ('point' if it names points), or remove station from the map"
        refuse(source, reason, columns.header_line or None, columns.columns["station"])


def _place(column: str | int, header: list[str], header_line: int, source: str) -> int:
    if isinstance(column, int):
        if column < 1:
            refuse(source, "the map counts columns from 1", None, column)
        return column - 1
    if header.count(column) != 1:
        problem = "is not in the header" if column not in header else "is in the header more than once; give its number"
        refuse(source, f"the map's column {problem}; columns: {', '.join(header)}", header_line or None, column)
    return header.index(column)


def _cell(cells: list[str], place: int, column: str | int, line: int, source: str) -> str:
    if place >= len(cells):
        refuse(source, f"the line has only {len(cells)} columns", line, column)
    return cells[place]


def _time(text: str, columns: ColumnMap, numbers: Numbers, line: int) -> tuple[float | None, bool | None]:
    """Return a time in seconds, and whether its zone is known.

    Returns:
        (time_s, has_zone): a number is returned unchanged, a date as seconds since 1970, a time of day as seconds since
        midnight. `has_zone` is None if the text is not a date.
    """
    if not text or "time" not in columns.columns:
        return None, None
    value = numbers.find(text, line)
    if value is not None:
        return value, None
    try:
        form = columns.time_format
        found = datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        said = columns.time_format or "seconds or an ISO time"
        refuse(numbers.source, f"{text!r} is not a time of the form {said}", line, columns.columns["time"])
    if columns.time_format in CLOCK_FORMATS:
        return found.hour * 3600.0 + found.minute * 60.0 + found.second + found.microsecond / 1e6, None
    has_zone = found.tzinfo is not None or "utc" in str(columns.columns["time"]).lower()
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp(), has_zone
