"""Units that a table names: in its header, in the line below that, or in the lines above."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.stations.export_format import MM_PER, AngleUnit, LengthUnit, refuse

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
_UNIT = re.compile(r"[\[(]\s*+([^\[\]()\s][^\[\]()]*+)[\])]|_(mm|cm|m|in|ft|deg|gon|rad)$", re.IGNORECASE)
_SAID_OF_COLUMNS = (
    "x y z e n h east easting north northing up height elevation left right face1 face2 actual measured local global "
    "horizontal zenith slope ortho orthometric ellipsoidal rechtswert hochwert höhe hoehe"
)
_REMARKS = frozenset(_SAID_OF_COLUMNS.split())
_NO_SECONDS = frozenset(("ms", "msec", "us", "µs", "μs", "ns", "min", "minutes", "h", "hours", "days"))
_PHRASE_ENDS = re.compile(r"[:=;,\t()\[\]\"]|/(?!s\b)|\band\b")
_BEFORE_M = frozenset(("in", "unit", "units", "is", "are"))


@dataclass(frozen=True)
class Quantity:
    """Kind of measured numbers.

    Attributes:
        name: in messages.
        words: word for a unit -> unit.
    """

    name: str
    words: Mapping[str, str]


LENGTHS, ANGLES = Quantity("length", _LENGTH_WORDS), Quantity("angles", _ANGLE_WORDS)


def without_unit(name: str) -> str:
    """Return the name of a column, in small letters, without what stands in brackets."""
    return _UNIT.sub("", name.lower())


def mm_of(name: str) -> float:
    """Return the millimetres of the unit that a column's name has; 1 where it has none."""
    return next(
        (MM_PER[_LENGTH_WORDS[word.lower()]] for word in bracket_words(name) if word.lower() in _LENGTH_WORDS), 1.0
    )


def bracket_words(name: str) -> list[str]:
    """Return what stands in brackets in the name of a column, and a unit at its end."""
    return [(found[1] or found[2]).strip() for found in _UNIT.finditer(name)]


def unit_of_columns(
    quantity: Quantity, header_line: int, columns: Sequence[str], units_line: int, below: Sequence[str], source: str
) -> tuple[str, str] | None:
    """Return the unit that the names of some columns have, or the cells below them, and where it is said.

    Args:
        quantity: of the columns.
        header_line: line of the names.
        columns: the names.
        units_line: line of the cells below; 0 where there is none.
        below: the cell below each name; "" where there is none.
        source: name of the file, for messages.

    Raises:
        DescriptionError: a word in brackets, or below a name, is no unit that is known, or there are two units.
    """
    units: dict[str, str] = {}  # unit -> the first column that has it
    for column, cell in zip(columns, below, strict=True):
        under = cell.strip("[]() ")
        said = [(header_line, word) for word in bracket_words(column)] + [(units_line, under)] * bool(under)
        for line, word in said:
            plain = word.lower()
            if plain in quantity.words:
                units.setdefault(quantity.words[plain], column)
            elif re.sub(r"[\W_]", "", plain) not in _REMARKS and (line == header_line or any(map(str.isalpha, word))):
                *known, last = dict.fromkeys(quantity.words.values())
                todo = f"export {', '.join(known)} or {last}, or take {word!r} out if it is a remark"
                refuse(source, f"{word!r} is no unit of {quantity.name} that is known; {todo}", line, column)
    if len(units) > 1:
        different = " and ".join(f"{cell!r} in {unit}" for unit, cell in units.items())
        refuse(source, f"the columns have different units, {different}; export them in one unit")
    return next(((unit, f"column {column!r}") for unit, column in units.items()), None)


def check_seconds(column: str, header_line: int, source: str) -> None:
    """Refuse a column of times in another unit than seconds."""
    for word in bracket_words(column):
        if word.lower() in _NO_SECONDS:
            refuse(source, f"times in {word!r} are not read; export seconds, or dates with times", header_line, column)


def unit_of_preamble(quantity: Quantity, lines: Sequence[str], source: str) -> tuple[str, str] | None:
    """Return the unit that the lines above a table name, and the word and line that say it.

    Raises:
        DescriptionError: they name two.
    """
    units: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        if "unit" in line.lower():
            for word in _unit_words(line.lower()):
                if word in quantity.words:
                    units.setdefault(quantity.words[word], f"{word!r} in line {number}")
    if len(units) > 1:
        different = " and ".join(f"{where} ({unit})" for unit, where in units.items())
        refuse(
            source,
            f"the lines above the table name different units of {quantity.name}: {different}; leave one, or name "
            f"the unit in the header, as in 'X [mm]'",
        )
    return next(iter(units.items()), None)


def _unit_words(line: str) -> list[str]:
    """Return the words of a line that may be units: `in` and `m` where they stand alone, `m` also after `in`."""
    found = []
    for phrase in _PHRASE_ENDS.split(line):
        words = [word.strip(".'") for word in phrase.split()]
        for place, word in enumerate(words):
            is_last = place == len(words) - 1
            if word == "in":
                is_unit = len(words) == 1
            elif word == "m":
                is_unit = is_last and (place == 0 or words[place - 1] in _BEFORE_M)
            else:
                is_unit = True
            found += [word] * is_unit
    return found
