"""Units given in the lines above a table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from drivers.stations.export_format import refuse
from drivers.stations.tables.named_units import ANGLES, LENGTHS, Quantity

_UNIT_WORD = re.compile(r"\b(?:units?|\w*einheit(?:en)?)\b")
_SAID = re.compile(r"""(?P<of>(?:\s+used|\s+of\s+\w+)?)[\s\])"]*(?:[:=;,\t\[(]|\b(?:is|are|in)\b)(?P<said>[^;\t]*)""")
_DIRECTLY = re.compile(r"(?:\bin\s|[:=\[(])\s*(?P<word>\w+|°)(?=\s*(?:$|[\])\",;.]))")
_BESIDE_UNITS = (
    "is are in of all the length lengths linear distance distances angle angles angular coordinate coordinates "
    "international intl decimal metric si"
)
_FILLERS = frozenset(_BESIDE_UNITS.split())
_OF_ANYTHING = "all the of used measure measurement export file height heights default project job"
_OF_ALL = frozenset(_OF_ANYTHING.split())
_PHRASE_ENDS = re.compile(r"[:=;,\t()\[\]\"]|/(?!s\b)|\band\b")
_LINE_MAX = 400  # characters of a line that are searched
_BEFORE_M = frozenset(("in", "unit", "units", "is", "are", "einheit", "einheiten"))


def unit_of_preamble(quantity: Quantity, lines: Sequence[str], source: str) -> tuple[str, str] | None:
    """Return (unit, its word and line) from the lines above a table; None if they give no unit.

    Args:
        quantity: quantity of the unit.
        lines: the lines above the table.
        source: name of the file, for error messages.

    Raises:
        DescriptionError: the lines give two different units or an unknown unit.
    """
    units: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        plain = line[:_LINE_MAX].lower()
        unknown = next(_unknown_words(quantity, plain), None)
        if unknown is not None:
            todo = f"export {quantity.known_units()}, or give the unit in the header, as in 'X [mm]'"
            refuse(source, f"{unknown!r} is not a known unit of {quantity.name}; {todo}", number)
        for word in _unit_words(quantity, plain):
            if word in quantity.words:
                units.setdefault(quantity.words[word], f"{word!r} in line {number}")
    if len(units) > 1:
        different = " and ".join(f"{where} ({unit})" for unit, where in units.items())
        refuse(
            source,
            f"the lines above the table give different units of {quantity.name}: {different}; keep one, or give "
            f"the unit in the header, as in 'X [mm]'",
        )
    return next(iter(units.items()), None)


def _unknown_words(quantity: Quantity, line: str) -> Iterator[str]:
    """Yield the words with which a line gives an unsupported unit for a quantity.

    Such a word is an unknown word after `units:`, or a known unit that is not supported, such as `US survey feet`.
    """
    other = ANGLES if quantity is LENGTHS else LENGTHS
    for found in _UNIT_WORD.finditer(line):
        said = _SAID.match(line, found.end())
        if said is None:
            continue
        of = set(re.findall(r"\w+", re.split(r"[:;=,\t]", line[: found.start()])[-1] + said["of"]))
        if not of <= _OF_ALL | quantity.subjects | other.subjects or of & other.subjects:
            continue  # units of an instrument or of temperatures
        if another := quantity.others.search(said["said"]):
            yield another[0]
        words = [word.strip(".'\"()[]") for word in re.split(r"[\s,/]+", said["said"])]
        first = next((word for word in words if word and word not in _FILLERS), "")
        if first.isalpha() and first not in {*LENGTHS.words, *ANGLES.words} and not other.others.search(first):
            yield first
    if quantity.subjects & set(re.findall(r"\w+", line)):
        for another in quantity.others.finditer(line):
            if re.search(r"(\bin\s|[:=\[(])\s*$", line[max(0, another.start() - 20) : another.start()]):
                yield another[0]


def _unit_words(quantity: Quantity, line: str) -> Iterator[str]:
    """Yield the words of a line that may be units.

    If the line contains the word "unit", these are all its words, else the words after `in`, `:`, `=` or a bracket. A
    line without "unit" must refer to the quantity and must not give a value, such as `Length of the rod (mm): 1200`.
    `in` and `m` are units if they stand alone, `m` also after words such as `in`.
    """
    if not _UNIT_WORD.search(line):
        if quantity.subjects & set(re.findall(r"\w+", line)) and not any(map(str.isdigit, line)):
            yield from (found["word"] for found in _DIRECTLY.finditer(line))
        return
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
            if is_unit:
                yield word
