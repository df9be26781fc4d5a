"""Lines of a text, their cells, and the numbers in them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable

from drivers.stations.export_format import refuse

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_BEFORE_BRACKET = re.compile(r"(?<!\s)\s++(?=[\[(])")  # blanks between a name and its unit
WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_NO_BLANKS = "an empty cell between blanks, or a blank in one, cannot be told; separate columns otherwise"
_LARGEST = 1e12  # of coordinates, angles and seconds in any unit


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
        return _BEFORE_BRACKET.sub("", line).split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field of more characters than any that means something
        return []


def is_no_row(line: str, separator: str) -> bool:
    """Return whether a line of a table is empty in all its cells, or a remark that begins with #."""
    return not line.strip(f'{separator} \t"') or line.lstrip().startswith("#")


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


def why_too_many(cells: list[str], due: int, separator: str) -> str:
    """Return what is wrong with a row of more cells than are due."""
    said = f"{len(cells)} cells where {due} are due"
    if separator == "," and not any("." in cell for cell in cells):
        todo = "export with decimal points, or with semicolons between columns"
        return f"{said}: commas separate columns and are decimal signs as well; {todo}"
    return f"{said}; {_NO_BLANKS}" if separator == " " else f"{said}: two lines may be one, or a cell too many"


def why_too_few(cells: list[str], due: int, separator: str) -> str:
    """Return what is wrong with a row of fewer cells than are due."""
    said = (
        f"{len(cells)} {'cell' if len(cells) == 1 else 'cells'} where {due} are due: one is missing, or the line is cut"
    )
    todo = "give each row its empty cells too, or take a column that is mostly empty out of the file"
    return f"{said}; {_NO_BLANKS if separator == ' ' else todo}"


def decimal_of(cells: Iterable[str]) -> str:
    """Return the sign before fractions: a comma where it is in numbers, between quotes if it separates them too."""
    return "," if any("," in cell and _NUMBER.fullmatch(cell) for cell in cells) else "."


class Numbers:
    """Numbers of a file, which has one sign before their fractions.

    Args:
        decimal: the sign.
        source: name of the file, for messages.
    """

    def __init__(self, decimal: str, source: str) -> None:
        self.decimal = decimal
        self.source = source
        self._first: dict[str, tuple[int, str]] = {}  # sign -> line and cell that had it first

    def find(self, cell: str, line: int) -> float | None:
        """Return the number in a cell, None where there is none.

        Raises:
            DescriptionError: it has another sign than a number before it, so one of them separates thousands.
        """
        for sign in ".,":
            if sign in cell and sign not in self._first and _NUMBER.fullmatch(cell):
                self._first[sign] = (line, cell)
        if len(self._first) > 1:
            before, other = next(iter(self._first.values()))
            both = f"{cell!r}, and {other!r} in line {before}: both a point and a comma stand before fractions"
            refuse(
                self.source, f"{both}, or one of them separates thousands; export without thousands separators", line
            )
        return number_of(cell, self.decimal)

    def read(self, cell: str, line: int, column: str | int) -> float:
        """Return the number in a cell.

        Raises:
            DescriptionError: there is none, or `find` raises it.
        """
        value = self.find(cell, line)
        if value is None:
            said = why_no_number(cell) if cell else "the cell is empty; leave out lines without a measurement"
            refuse(self.source, said, line, column)
        return value
