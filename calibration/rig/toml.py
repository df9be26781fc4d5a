"""Parsing of untrusted TOML with bounds on time, depth and numbers; and quoting.

The time that tomllib needs grows with the square of the number of parts of a dotted key, and Python's integers are
unbounded.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from typing import Any

LONGEST = 1 << 19  # characters; the largest known rig has 6,000
_PARTS_MAX = 100  # of the dotted keys in a line
_PART = re.compile(r"""[\w"'-][ \t]*\.(?=[ \t]*[\w"'-])""")
_INTEGER_MAX = 1 << 63
_HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?\s*(#.*)?")
_KEY = re.compile(r"\s*\"?([\w-]+)\"?\s*[.=]")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Raises:
        ValueError: the text is not TOML, is too long, is nested too deeply, or has numbers beyond 64 bits; the message
            names the place.
    """
    if len(text) > LONGEST:
        raise ValueError(f"the text has {len(text):,} characters; the maximum is {LONGEST:,}")
    for number, line in enumerate(text.splitlines(), 1):
        if len(line) > 2 * _PARTS_MAX and len(_PART.findall(line)) > _PARTS_MAX:
            raise ValueError(f"line {number}: more than {_PARTS_MAX} dots in its keys; use tables instead")
    try:
        document = tomllib.loads(text.removeprefix("\ufeff"))  # the byte-order mark of Windows editors
    except RecursionError as error:
        raise ValueError("arrays or tables are nested too deeply") from error
    _check_integers(document)
    return document


def quoted(text: str) -> str:
    """Return a text as a TOML string; characters that are not printable are escaped."""
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
            raise ValueError(f"{key}: the whole number does not fit into 64 bits")


def line_of(text: str, where: Sequence[str | int]) -> int | None:
    """Return the line of a key, from 1; if the key is missing, the line of its table; None if that is missing too.

    Args:
        text: a TOML document in which each header, `[name]` or `[[name]]`, is on a line of its own.
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
