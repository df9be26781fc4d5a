"""Splitting a text into lines and cells, and reading the numbers in the cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable

from drivers.stations.export_format import refuse

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_BEFORE_BRACKET = re.compile(r"(?<!\s)\s++(?=[\[(])")  # blanks between a name and its unit
WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_NO_BLANKS = "blanks cannot separate columns if a cell is empty or contains a blank; use another separator"
_LARGEST = 1e12  # limit for coordinates, angles and seconds in any unit


def lines_of(text: str) -> list[str]:
    """Return the lines of a text."""
    return text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")


def line_at(lines: list[str], number: int, source: str) -> str:
    """Return the line with a number given by a map.

    Args:
        lines: lines of the file.
        number: line number, from 1.
        source: name of the file, for error messages.

    Raises:
        DescriptionError: the file is shorter.
    """
    if number > len(lines):
        refuse(source, f"the map's header is in line {number}, the file has {len(lines)} lines; use the file's map")
    return lines[number - 1]


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    if separator == " ":
        return _BEFORE_BRACKET.sub("", line).split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field is longer than the csv module allows
        return []


def is_no_row(line: str, separator: str) -> bool:
    """Return True if all cells of a line are empty, or if the line is a comment that begins with #."""
    return not line.strip(f'{separator} \t"') or line.lstrip().startswith("#")


def number_of(cell: str, decimal: str) -> float | None:
    """Return the number in a cell; None if there is none, or if it is larger than any instrument measures."""
    if not _NUMBER.fullmatch(cell) or (decimal == "." and "," in cell):
        return None
    value = float(cell.replace(",", "."))
    return value if abs(value) < _LARGEST else None


def why_no_number(cell: str) -> str:
    """Return the error text for a cell in which `number_of` finds no number."""
    is_too_large = _NUMBER.fullmatch(cell) and number_of(cell, ",") is None
    return f"{cell!r} is {'larger than any instrument measures' if is_too_large else 'not a number'}"


def why_too_many(cells: list[str], due: int, separator: str) -> str:
    """Return the error text for a row with more cells than expected (`due`)."""
    said = f"{len(cells)} cells instead of {due}"
    if separator == "," and not any("." in cell for cell in cells):
        todo = "export with decimal points, or with semicolons between columns"
        return f"{said}: commas are used both between columns and as decimal signs; {todo}"
    return f"{said}; {_NO_BLANKS}" if separator == " " else f"{said}: remove the extra cell, or split joined lines"


def why_too_few(cells: list[str], due: int, separator: str) -> str:
    """Return the error text for a row with fewer cells than expected (`due`)."""
    said = (
        f"{len(cells)} {'cell' if len(cells) == 1 else 'cells'} instead of {due}: a cell is missing or the line is cut"
    )
    todo = "write empty cells too, or remove a column that is mostly empty from the file"
    return f"{said}; {_NO_BLANKS if separator == ' ' else todo}"


def decimal_of(cells: Iterable[str]) -> str:
    """Return the decimal sign: a comma if any number has one (quoted if commas also separate columns), else a point."""
    return "," if any("," in cell and _NUMBER.fullmatch(cell) for cell in cells) else "."


class Numbers:
    """Reader of the numbers of a file, all of which must use the same decimal sign.

    Args:
        decimal: the decimal sign.
        source: name of the file, for error messages.
    """

    def __init__(self, decimal: str, source: str) -> None:
        self.decimal = decimal
        self.source = source
        self._first: dict[str, tuple[int, str]] = {}  # sign -> line and cell in which it first appears

    def find(self, cell: str, line: int) -> float | None:
        """Return the number in a cell; None if there is none.

        Raises:
            DescriptionError: the file has both decimal points and commas, so one of them may separate thousands.
        """
        for sign in ".,":
            if sign in cell and sign not in self._first and _NUMBER.fullmatch(cell):
                self._first[sign] = (line, cell)
        if len(self._first) > 1:
            before, other = next(iter(self._first.values()))
            both = f"{cell!r}, and {other!r} in line {before}: both points and commas are decimal signs"
            refuse(
                self.source, f"{both}, or one of them separates thousands; export without thousands separators", line
            )
        return number_of(cell, self.decimal)

    def read(self, cell: str, line: int, column: str | int) -> float:
        """Return the number in a cell.

        Raises:
            DescriptionError: there is no number, or `find` raises the error.
        """
        value = self.find(cell, line)
        if value is None:
            said = why_no_number(cell) if cell else "the cell is empty; remove lines without a measurement"
            refuse(self.source, said, line, column)
        return value
