"""Units: the words for them, and the units that a table gives in its header or in the line below."""

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
    "horizontal zenith slope ortho orthometric ellipsoidal rechtswert hochwert höhe hoehe rw hw grid nn nhn msl"
)
_REMARKS = frozenset(_SAID_OF_COLUMNS.split())
_REMARK = re.compile(r"\d+|(?:utm|gk)\d*[a-z]?")  # number of a column, zone of a grid
_NO_SECONDS = re.compile(r"[mµμun]s|[mun]secs?|(?:milli|micro|nano)sec\w*|min|minutes|h|hours|days|millis")
_OF_LENGTHS = (
    "coordinate coordinates dimension dimensions distance distances length lengths linear koordinaten maße "
    "abmessungen längen längeneinheit strecken values measurements werte"
)


@dataclass(frozen=True)
class Quantity:
    """Kind of a measured quantity.

    Attributes:
        name: name in messages.
        words: word for a unit -> unit.
        others: pattern of units that are not supported.
        subjects: words that refer to the quantity.
    """

    name: str
    words: Mapping[str, str]
    others: re.Pattern[str]
    subjects: frozenset[str]

    def known_units(self) -> str:
        """Return the supported units as a list in a sentence."""
        *units, last = dict.fromkeys(self.words.values())
        return f"{', '.join(units)} or {last}"


LENGTHS = Quantity(
    "length",
    _LENGTH_WORDS,
    re.compile(
        r"\b(?:us[- ]?(?:survey[- ]?)?(?:ft|feet|foot)|survey[- ](?:ft|feet|foot)|usft|ftus|sft|km|kilomet\w+|[µμ]m|"
        r"microns?|micromet\w+|yards?|yd)\b"
    ),
    frozenset(_OF_LENGTHS.split()),
)
ANGLES = Quantity(
    "angles",
    _ANGLE_WORDS,
    re.compile(r"\b(?:dms|mils?|minutes)\b"),
    frozenset(("angle", "angles", "angular", "winkel", "winkeleinheit")),
)


def without_unit(name: str) -> str:
    """Return the name of a column in lower case, without text in brackets and without a unit at its end."""
    return _UNIT.sub("", name.lower())


def mm_of(name: str, otherwise_mm: float) -> float:
    """Return the length in mm of the unit in a column's name, or `otherwise_mm` if it has none."""
    words = [word.lower() for word in bracket_words(name)]
    return next((MM_PER[_LENGTH_WORDS[word]] for word in words if word in _LENGTH_WORDS), otherwise_mm)


def bracket_words(name: str) -> list[str]:
    """Return the texts in brackets in the name of a column, and a unit at its end."""
    return [(found[1] or found[2]).strip() for found in _UNIT.finditer(name)]


def unit_of_columns(
    quantity: Quantity, header_line: int, columns: Sequence[str], units_line: int, below: Sequence[str], source: str
) -> tuple[str, str] | None:
    """Return (unit, source of the unit) from the names of some columns or the cells below them; None if there is none.

    Args:
        quantity: quantity of the columns.
        header_line: line number of the names.
        columns: names of the columns.
        units_line: line number of the cells below the names; 0 if there is none.
        below: the cell below each name; "" if there is none.
        source: name of the file, for error messages.

    Raises:
        DescriptionError: a word in brackets or below a name is not a known unit, or there are two different units.
    """
    units: dict[str, str] = {}  # unit -> the first column that has it
    for column, cell in zip(columns, below, strict=True):
        for line, word in _words_of(column, header_line, cell, units_line):
            plain = word.lower()
            if plain in quantity.words:
                units.setdefault(quantity.words[plain], column)
            elif not _is_remark(plain) and (line == header_line or any(map(str.isalpha, word))):
                todo = f"export {quantity.known_units()}, or remove {word!r} if it is a remark"
                refuse(source, f"{word!r} is not a known unit of {quantity.name}; {todo}", line, column)
    if len(units) > 1:
        different = " and ".join(f"{cell!r} in {unit}" for unit, cell in units.items())
        refuse(source, f"the columns have different units, {different}; export them in one unit")
    return next(((unit, f"column {column!r}") for unit, column in units.items()), None)


def _words_of(column: str, header_line: int, below: str, units_line: int) -> list[tuple[int, str]]:
    """Return line number and text of each word in a column's name and in the cell below that may be its unit."""
    under = below.strip("[]() ")
    return [(header_line, word) for word in bracket_words(column)] + [(units_line, under)] * bool(under)


def _is_remark(word: str) -> bool:
    plain = re.sub(r"[\W_]", "", word)
    return plain in _REMARKS or bool(_REMARK.fullmatch(plain))


def check_seconds(column: str, header_line: int, below: str, units_line: int, source: str) -> None:
    """Refuse a column of times whose name, or the cell below, gives a unit other than seconds.

    Args:
        column: name of the column.
        header_line: line number of the names.
        below: cell below the name; "" if there is none.
        units_line: line number of that cell; 0 if there is none.
        source: name of the file, for error messages.

    Raises:
        DescriptionError: the unit is not seconds.
    """
    for line, word in _words_of(column, header_line, below, units_line):
        if _NO_SECONDS.fullmatch(word.lower()):
            refuse(source, f"times in {word!r} are not supported; export seconds, or dates with times", line, column)
