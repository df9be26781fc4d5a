"""The lines of a rig file that `rigcal init` has marked, because only the drawings have their values."""

from __future__ import annotations

_MARK = "FILL IN"


def fill_in_lines(text: str) -> list[int]:
    """Return the numbers of the lines of a rig file that are still marked to be filled in."""
    lines = enumerate(text.splitlines(), start=1)
    return [number for number, line in lines if _MARK in line and not line.lstrip().startswith("#")]


def fill_in_note(text: str) -> str:
    """Return a sentence about the lines that are still marked to be filled in; "" if there are none."""
    lines = fill_in_lines(text)
    if not lines:
        return ""
    where = f"line{'s' * (len(lines) > 1)} {', '.join(map(str, lines))}"
    return f"{where}: still to be filled in from the drawings; remove the words {_MARK} there when it is done"
