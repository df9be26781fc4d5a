"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table."""
    yield from map(_row, (header, ["---"] * len(header), *rows))


def _row(cells: Sequence[str]) -> str:
    """Return a line of a table, with vertical bars in cells escaped."""
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
