"""TOML texts that someone else may have written: tomllib with bounds on time, depth and numbers.

tomllib takes the square of the number of parts of a dotted key, and Python's integers have no end.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

LONGEST = 1 << 19  # characters; the largest rig that is known has 6,000
_PARTS_MAX = 100  # of the dotted keys of a line
_PART = re.compile(r"""[\w"'-][ \t]*\.(?=[ \t]*[\w"'-])""")
_INTEGER_MAX = 1 << 63


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
        document = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    _check_integers(document)
    return document


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
