"""Lines and tables for people on the terminal.

Names of set-ups, operators, prisms and files come from anyone: everything is escaped by `shown`. Colour comes from
styles alone, and only where a terminal shows it.
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
_LEAST_WRAPPED = 30  # columns for the words of a table's last column
_MOST_SHOWN = 0.99  # of work that goes on: it is not at its end
# xterm's sequences: another screen without a cursor, its first place, and back to the terminal as it was.
_BEGIN, _HOME, _END = "\x1b[?1049h\x1b[?25l", "\x1b[H", "\x1b[?25h\x1b[?1049l"
_BETWEEN = "  "  # the columns of a table
_REST_OF_LINE, _REST_OF_SCREEN = "\x1b[K", "\x1b[J"


class Coloured(NamedTuple):
    """A cell of a table in a colour, as `click.style` names it."""

    text: str
    colour: str


def echo(text: object = "", **style: Any) -> None:
    """Print one line on standard output, with the style options of `click.style`."""
    click.secho(shown(text), color=_color(), **style)


def echo_error(text: str, level: int = logging.INFO) -> None:
    """Print lines on standard error; in the journal each with its priority.

    Args:
        text: the lines.
        level: how important they are, as `logging` has it.
    """
    prefix = priority_prefix(level) if is_journal(sys.stderr) else ""
    click.echo("\n".join(prefix + line for line in shown_lines(text).split("\n")), err=True)


def echo_text(text: str) -> None:
    """Print lines on standard output as they are, but for what is not safe to show."""
    click.echo(shown_lines(text))


def begin_screen() -> None:
    """Take another screen of the terminal, without a cursor; `end_screen` gives it back."""
    click.echo(_BEGIN, nl=False, color=True)


def end_screen() -> None:
    """Show the terminal again as it was before `begin_screen`."""
    click.echo(_END, nl=False, color=True)


def draw_screen(lines: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
    """Write lines over the screen from its first line on, so that nothing flickers.

    Args:
        lines: each with its style, as `click.style` names it.
    """
    is_plain = _color() is False
    texts = [shown(text) if is_plain else click.style(shown(text), **style) for text, style in lines]
    drawn = "".join(f"{text}{_REST_OF_LINE}\r\n" for text in texts)
    click.echo(_HOME + drawn + _REST_OF_SCREEN, nl=False, color=True)  # without colours it is a screen all the same


def echo_list(title: str, sentences: Sequence[str], most: int = _LISTED) -> None:
    """Print a titled list of at most `most` sentences; nothing where there are none."""
    if not sentences:
        return
    echo(f"{title}:", bold=True)
    for sentence in sentences[:most]:
        echo(f"  - {shown(sentence)}")
    if len(sentences) > most:
        echo(f"  and {len(sentences) - most} more (--json has all)")


def echo_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str | Coloured]],
    *,
    title: str = "",
    text_columns: Sequence[int] | None = None,
    bold: Sequence[bool] = (),
) -> None:
    """Print a table, in which nothing is cut short: where a terminal is narrow, the words of the last column wrap.

    Args:
        header: a heading for each column.
        rows: the cells.
        title: the line above.
        text_columns: columns that are set flush left; all by default.
        bold: one flag a row.
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


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, which takes an s where there are several."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def percent(share: float) -> str:
    """Return the share that is done of work that goes on; never 100 %."""
    return f"{min(share, _MOST_SHOWN):.0%}".replace("%", " %")


def _lines(text: str, width: int) -> list[str]:
    """Return a text in lines of so many columns; a word that is longer, as a path may be, is not broken."""
    if _width(text) <= width:
        return [text]
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _width(text: str) -> int:
    """Return the number of columns that a terminal gives to a text."""
    if text.isascii():
        return len(text)
    narrow = sum(not unicodedata.combining(c) for c in text)
    return narrow + sum(unicodedata.east_asian_width(c) in "WF" for c in text)


def _color() -> bool | None:
    """Return click's `color`: none where NO_COLOR is set (https://no-color.org) or the terminal has none."""
    return False if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" else None
