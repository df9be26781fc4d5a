"""Bounds on what a client says: names, texts and numbers of a command, checked before anything is done."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from daemon.control import CommandError

MAX_TEXT_CHARACTERS = 500
MAX_ENTRIES = 100

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def identifier(arguments: Mapping[str, Any], key: str, what: str, default: str = "") -> str:
    """Return the name that `arguments` gives under `key`; CommandError if it is none."""
    name = arguments.get(key) or default
    if not isinstance(name, str) or not _ID.fullmatch(name):
        raise CommandError(f"{what} is 1 to 64 letters, digits, '.', '_' or '-', not {name!r:.80}")
    return name


def text_argument(arguments: Mapping[str, Any], key: str) -> str:
    """Return the short text that `arguments` gives under `key`, "" by default; CommandError if it is none."""
    value = arguments.get(key, "")
    if not isinstance(value, str) or len(value) > MAX_TEXT_CHARACTERS or not value.isprintable():
        raise CommandError(
            f"{key} must be a text of at most {MAX_TEXT_CHARACTERS} printable characters, not {value!r:.80}"
        )
    return value


def mapping_argument(arguments: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return the object that `arguments` gives under `key`, empty by default; CommandError if it is none."""
    value = arguments.get(key, {})
    if not isinstance(value, dict) or len(value) > MAX_ENTRIES:
        raise CommandError(f"{key} must be an object of at most {MAX_ENTRIES} entries, not {value!r:.80}")
    return value


def number_argument(arguments: Mapping[str, Any], key: str, limit: float = 1e6) -> float | None:
    """Return the number that `arguments` gives under `key`, None by default; CommandError if it is none."""
    value = arguments.get(key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (is_number and abs(value) <= limit):
        raise CommandError(f"{key:.80} must be a finite number of at most {limit:g}, not {value!r:.80}")
    return value
