"""TOML: texts that someone else may have written, by tomllib with bounds on time, depth and numbers; and quoting.

tomllib takes the square of the number of parts of a dotted key, and Python's integers have no end.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from typing import Any

LONGEST = 1 << 19  # characters; the largest rig that is known has 6,000
_PARTS_MAX = 100  # of the dotted keys of a line
_PART = re.compile(r"""[\w"'-][ \t]*\.(?=[ \t]*[\w"'-])""")
_INTEGER_MAX = 1 << 63
_HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?\s*(#.*)?")
_KEY = re.compile(r"\s*\"?([\w-]+)\"?\s*[.=]")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Raises:
        ValueError: it is no TOML, too long, nested too deeply, or has numbers beyond 64 bits; the message says where.
    """
    if len(text) > LONGEST:
        raise ValueError(f"it has {len(text):,} characters, {LONGEST:,} at most are read")
    for number, line in enumerate(text.splitlines(), 1):
        if len(line) > 2 * _PARTS_MAX and len(_PART.findall(line)) > _PARTS_MAX:
            raise ValueError(f"line {number}: more than {_PARTS_MAX} points; what is meant by it?")
    try:
        document = tomllib.loads(text.removeprefix("\ufeff"))  # a mark that editors on Windows set
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    _check_integers(document)
    return document


def quoted(text: str) -> str:
    """Return a text as a TOML string; what cannot be seen is escaped."""
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'


def _check_integers(document: dict[str, Any]) -> None:
    waiting: list[tuple[str, Any]] = list(document.items())
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, dict):
            waiting += value.items()
        elif isinstance(value, list):
            waiting += [(key, item) for item in value]
        elif isinstance(value, int) and not -_INTEGER_MAX <= value < _INTEGER_MAX:
            raise ValueError(f"{key}: a whole number beyond 64 bits")


def line_of(text: str, where: Sequence[str | int]) -> int | None:
    """Return the line of a key, from 1; of its table where the key is missing, None where that is missing too.

    Args:
        text: a TOML document whose tables have a line of their own each: `[name]` and `[[name]]`.
        where: names of tables and keys; a number after the name of an array counts its tables from 1.
    """
    if not where:
        return None
    table, *rest = where
    wanted = rest.pop(0) if rest and isinstance(rest[0], int) else 1
    key = str(rest[0]) if rest else ""
    count, inside, found, top = 0, False, None, True
    for number, line in enumerate(text.splitlines(), 1):
        header, entry = _HEADER.fullmatch(line), _KEY.match(line)
        if header:
            top, inside = False, header[1] == table
            count += inside
            inside = inside and count == wanted
            found = number if inside else found
        elif entry and ((inside and entry[1] == key) or (top and entry[1] == table)):
            return number
    return found
