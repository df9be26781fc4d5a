"""Lines and tables for people on the terminal.

Names of set-ups, operators, prisms and files are untrusted: everything is escaped by `shown`. Colours are used only if
the terminal shows them.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import click

from daemon.host.safe_output import shown, shown_lines
from daemon.host.systemd import is_journal, priority_prefix

_LISTED = 10
_LEAST_WRAPPED = 30  # smallest width at which a table's last column is wrapped
_MOST_SHOWN = 0.99  # largest share shown for unfinished work
# Escape sequences of xterm: alternate screen without a cursor, cursor to its origin, and back to the normal screen.
_BEGIN, _HOME, _END = "\x1b[?1049h\x1b[?25l", "\x1b[H", "\x1b[?25h\x1b[?1049l"
_BETWEEN = "  "  # between columns of a table
_REST_OF_LINE, _REST_OF_SCREEN = "\x1b[K", "\x1b[J"


class Coloured(NamedTuple):
    """A cell of a table with a colour name of `click.style`; "" for no colour."""

    text: str
    colour: str


def echo(text: object = "", **style: Any) -> None:
    """Print one line to standard output, with the style options of `click.style`."""
    click.secho(shown(text), color=_color(), **style)


def echo_error(text: str, level: int = logging.INFO) -> None:
    """Print lines to standard error; if that is the journal, each line has its priority.

    Args:
        text: the lines.
        level: their level in `logging`.
    """
    prefix = priority_prefix(level) if is_journal(sys.stderr) else ""
    click.echo("\n".join(prefix + line for line in shown_lines(text).split("\n")), err=True)


def echo_text(text: str) -> None:
    """Print lines to standard output, with only unsafe characters escaped."""
    click.echo(shown_lines(text))


def begin_screen() -> None:
    """Switch to the terminal's alternate screen, without a cursor, until `end_screen`."""
    click.echo(_BEGIN, nl=False, color=True)


def end_screen() -> None:
    """Switch back to the screen from before `begin_screen`."""
    click.echo(_END, nl=False, color=True)


def draw_screen(lines: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
    """Overwrite the screen from its first line without clearing it, so that it does not flicker.

    Args:
        lines: each with its style options of `click.style`.
    """
    is_plain = _color() is False
    texts = [shown(text) if is_plain else click.style(shown(text), **style) for text, style in lines]
    drawn = "".join(f"{text}{_REST_OF_LINE}\r\n" for text in texts)
    click.echo(_HOME + drawn + _REST_OF_SCREEN, nl=False, color=True)  # keeps the sequences also without colours


def echo_list(title: str, sentences: Sequence[str], most: int = _LISTED) -> None:
    """Print a titled list of at most `most` sentences; print nothing if there are none."""
    if not sentences:
        return
    echo(f"{title}:", bold=True)
    for sentence in sentences[:most]:
        echo(f"  - {shown(sentence)}")
    if len(sentences) > most:
        echo(f"  and {len(sentences) - most} more (--json lists all)")


def echo_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str | Coloured]],
    *,
    title: str = "",
    text_columns: Sequence[int] | None = None,
    bold: Sequence[bool] = (),
) -> None:
    """Print a table without truncating any cell: on a narrow terminal the last column is wrapped.

    Args:
        header: a heading for each column.
        rows: the cells.
        title: a line above the table; "" for none.
        text_columns: indices of left-aligned columns; all by default.
        bold: one flag per row; empty for no bold rows.
    """
    cells = [[cell if isinstance(cell, Coloured) else Coloured(cell, "") for cell in row] for row in rows]
    texts = [[shown(name) for name in header], *([shown(cell.text) for cell in row] for row in cells)]
    widths = [max(map(_width, column)) for column in zip(*texts, strict=True)]
    is_left = [text_columns is None or column in text_columns for column in range(len(header))]
    before = sum(widths[:-1]) + len(_BETWEEN) * (len(widths) - 1)
    room = shutil.get_terminal_size((0, 0)).columns - before
    widths[-1] = min(widths[-1], room) if is_left[-1] and room >= _LEAST_WRAPPED else widths[-1]

    def padded(column: int, text: str) -> str:
        space = " " * (widths[column] - _width(text))
        return text + space if is_left[column] else space + text

    if title:
        echo(title, bold=True)
    echo(_BETWEEN.join(padded(i, text) for i, text in enumerate(texts[0])).rstrip())
    echo(_BETWEEN.join("\N{BOX DRAWINGS LIGHT HORIZONTAL}" * width for width in widths))
    for number, (row, line) in enumerate(zip(cells, texts[1:], strict=True)):
        is_bold = bool(bold) and bold[number]
        first, *further = _lines(line[-1], widths[-1])
        styled = [
            click.style(padded(i, text), fg=cell.colour or None, bold=is_bold or None)
            if cell.colour or is_bold
            else padded(i, text)
            for i, (cell, text) in enumerate(zip(row, [*line[:-1], first], strict=True))
        ]
        click.echo(_BETWEEN.join(styled).rstrip(), color=_color())
        for text in further:
            echo(" " * before + text)


def percent(share: float) -> str:
    """Return the share of unfinished work that is done as percentage; never 100 %."""
    return f"{min(share, _MOST_SHOWN):.0%}".replace("%", " %")


def _lines(text: str, width: int) -> list[str]:
    """Wrap a text to lines of `width` columns; a longer word, such as a path, is not broken."""
    if _width(text) <= width:
        return [text]
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _width(text: str) -> int:
    """Return the number of terminal columns that a text occupies."""
    if text.isascii():
        return len(text)
    narrow = sum(not unicodedata.combining(c) for c in text)
    return narrow + sum(unicodedata.east_asian_width(c) in "WF" for c in text)


def _color() -> bool | None:
    """Return click's `color`: False if NO_COLOR is set (https://no-color.org) or the terminal has no colours."""
    return False if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" else None
