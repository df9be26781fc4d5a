"""Guessing the separator, header, units and columns of text tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime

from drivers.stations.export_format import ColumnMap, Guess, Role, refuse
from drivers.stations.tables.cells import WHOLE, cells_of, decimal_of, is_no_row, lines_of, number_of, why_too_many
from drivers.stations.tables.columns import CARTESIAN, POLAR, one_of_each, roles_of_cells
from drivers.stations.tables.named_units import ANGLES, LENGTHS, check_seconds, unit_of_columns
from drivers.stations.tables.units_above import unit_of_preamble

_SEPARATORS = (";", "\t", ",", " ")
_HEAD_LINES = 200  # longest preamble
_TIME_FORMATS = ("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S")
CLOCK_FORMATS = ("%H:%M:%S.%f", "%H:%M:%S")


def guess_table(text: str, source: str, name: str) -> Guess:
    """Guess how to read a table.

    Args:
        text: content of the file.
        source: name of the file, for error messages.
        name: name of the format.

    Raises:
        DescriptionError: no line names coordinates, or angles and a distance, and no line has a point and three
            numbers.
    """
    lines = lines_of(text)
    for separator in _SEPARATORS:
        for number, line in enumerate(lines[:_HEAD_LINES], 1):
            roles = roles_of_cells(cells_of(line, separator))
            if roles.keys() >= set(CARTESIAN) or roles.keys() >= set(POLAR):
                if separator == " " and any(
                    cell[-1] in ",;" for cell in lines[number : number + 1] for cell in cell.split()
                ):
                    continue  # a comment that names the columns; the rows use a different separator
                return _with_header(lines, separator, number, roles, name, source)
    return _without_header(lines, source, name)


def _with_header(
    lines: list[str], separator: str, header: int, found: dict[Role, list[str]], name: str, source: str
) -> Guess:
    cells = cells_of(lines[header - 1], separator)
    notes = [f"line {header} is the header; columns are separated by {_said(separator)}"]
    first = header + 1
    while first < len(lines) and not any(map(str.isdigit, lines[first - 1])):
        first += 1  # a line of units or an empty line
    roles = one_of_each(found, header, source, notes)
    by_role = ", ".join(f"{role}: {cell!r}" for role, cell in roles.items())
    notes.insert(1, f"columns by their names: {by_role}")
    if "point" not in roles:
        notes.append("no column names the points, so they are numbered 1, 2, ... in the order of the file")
    sample = _sample(lines, separator, first)

    def sampled(of: list[str]) -> list[str]:
        places = [cells.index(cell) for cell in of]
        return [row[place] for row in sample for place in places if place < len(row)]

    lengths = [roles[role] for role in (*CARTESIAN, "distance") if role in roles]
    angles = [roles[role] for role in ("hz", "zenith") if role in roles]
    others: tuple[Role, ...] = ("time", "prism_constant", "target_height")
    numbers = sampled([*lengths, *angles, *(roles[role] for role in others if role in roles)])
    decimal = decimal_of(numbers)
    notes += _decimal_note(numbers)
    units_line = next((at for at in range(header + 1, first) if not is_no_row(lines[at - 1], separator)), 0)
    units = cells_of(lines[units_line - 1], separator) if units_line else []

    def below(of: list[str]) -> list[str]:
        places = [cells.index(cell) for cell in of]
        return [units[place] if place < len(units) else "" for place in places]

    if "time" in roles:
        check_seconds(roles["time"], header, below([roles["time"]])[0], units_line, source)
    given: dict[str, str] = {}
    for key, quantity, of, by_size in (
        ("length_unit", LENGTHS, lengths, _length_by_size),
        ("angle_unit", ANGLES, angles, _angle_by_size),
    ):
        if not of:
            continue
        named = unit_of_columns(quantity, header, of, units_line, below(of), source)
        named = named or unit_of_preamble(quantity, lines[: header - 1], source)
        if named is None:
            largest = _largest(sampled(of), decimal)
            given[key] = by_size(largest)
            greatest = f"the largest number is {largest:g}, so {given[key]} is assumed"
            notes.append(f"the file gives no known unit of {quantity.name}; {greatest}")
        else:
            given[key] = named[0]
            notes.append(f"the unit of {quantity.name} is {named[0]}, according to {named[1]}")
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


def _sample(lines: list[str], separator: str, first: int) -> list[list[str]]:
    """Return the cells of up to 201 rows from line `first` on."""
    return [cells_of(line, separator) for line in lines[first - 1 : first + 200] if not is_no_row(line, separator)]


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
                coordinates = [cell for row in _sample(lines, separator, number) for cell in row[1:4]]
                largest = _largest(coordinates, decimal)
                named = unit_of_preamble(LENGTHS, lines[: number - 1], source)
                length = named[0] if named else _length_by_size(largest)
                why = f"according to {named[1]}" if named else f"as the largest coordinate is {largest:g}"
                notes = (
                    f"no header; from line {number} on: point, x, y, z, separated by {_said(separator)}",
                    *_decimal_note(coordinates),
                    f"the unit of length is {length}, {why}",
                )
                columns = {"point": 1, "x": 2, "y": 3, "z": 4}
                given = {"format": name, "separator": separator, "decimal": decimal, "first_line": number}
                return Guess(ColumnMap.model_validate({**given, "length_unit": length, "columns": columns}), notes)
    refuse(
        source,
        "no line names columns x, y, z (or hz, v and a slope distance) or begins with a point and three numbers; "
        "write a map and pass it with --map",
    )


def _check_without_header(lines: list[str], separator: str, first: int, source: str) -> None:
    """Refuse an unknown header, a damaged row, and commas used both as separators and as decimal signs."""
    cells = cells_of(lines[first - 1], separator)
    for number, line in enumerate(lines[: first - 1], 1):
        before = cells_of(line, separator)
        numbers = sum(number_of(cell, ",") is not None for cell in before)
        # Rows with a separator at their end have one cell more than their header
        is_as_wide = len(before) == len(cells) or (separator != " " and sum(map(bool, before)) >= 4)
        if is_as_wide and any(before[1:]) and not numbers:
            said = f"its names are unknown ({', '.join(before)})"
            advice = "name the columns point, x, y and z, or delete the line if it is a comment"
            refuse(source, f"this line looks like a header, but {said}; {advice}", number)
        if numbers > (0 if len(before) == len(cells) else 1):
            said = f"the line has numbers like the points from line {first} on, but is not point, x, y, z"
            refuse(source, f"{said}; correct it, or delete it if it is a comment", number)
    if separator == "," and len(cells) >= 7 and all(map(WHOLE.fullmatch, cells[1:7])):
        refuse(source, why_too_many(cells, 4, separator), first)


def _time_format(sample: list[list[str]], header: list[str], roles: dict[Role, str], notes: list[str]) -> str:
    if "time" not in roles or not sample:
        return ""
    text = _time_text(sample[0], header, roles)
    for known in (*_TIME_FORMATS, *CLOCK_FORMATS):
        try:
            datetime.strptime(text, known)
        except ValueError:
            continue
        notes.append(f"times such as {text!r} are read as {known}")
        return known
    return ""


def _said(separator: str) -> str:
    return {";": "semicolons", "\t": "tabs", ",": "commas", " ": "blanks"}[separator]


def _time_text(cells: list[str], header: list[str], roles: Mapping[Role, str]) -> str:
    places = [header.index(roles[role]) for role in ("date", "time") if role in roles]
    return " ".join(cells[place] for place in places if place < len(cells))
