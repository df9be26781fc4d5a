"""Text that is safe to show: names, and messages that quote them, on their way to a terminal, a log or a report."""

from __future__ import annotations

import unicodedata

MOST_CHARACTERS = 4000
# Control, format (bidirectional overrides among them), surrogate, private and unassigned characters, line and paragraph
# separators: invisible, or able to move the cursor, to reorder what stands beside them, or to begin a line.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def shown(text: object, most: int = MOST_CHARACTERS) -> str:
    """Return `text` on one line, with unsafe characters escaped as Python writes them and at most `most` characters."""
    text = str(text)
    if len(text) > most:
        text = f"{text[:most]}..."
    if text.isprintable():
        return text
    return "".join(_escaped(c) if unicodedata.category(c) in _UNSAFE else c for c in text)


def shown_lines(text: str) -> str:
    """Return text of several lines, each of them safe to show."""
    return "\n".join(shown(line) for line in text.split("\n"))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
