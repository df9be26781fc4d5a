"""What commands print for people: text as it is, whoever it comes from.

Names of set-ups, operators, prisms and files are never taken for markup, emoji codes or escape sequences. Colour comes
from `style=` alone, and from `coloured`.
"""

from __future__ import annotations

import sys
from typing import Any

import click
from rich.console import Console
from rich.text import Text

from daemon.journal import is_journal, priority_prefix
from daemon.plain_text import shown, shown_lines


class Terminal(Console):
    """A console that prints plain text, in tables too; settings are those of `rich.console.Console`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text of a line or a cell, safe to show."""
        return super().render_str(shown(text), **options)


def coloured(text: str, style: str) -> Text:
    """Return plain text in a colour."""
    return Text(shown(text), style=style)


def echo(text: object) -> None:
    """Print lines on standard output."""
    click.echo(shown_lines(str(text)))


def echo_error(text: str, level: int) -> None:
    """Print lines on standard error; where that is the journal, each with its priority.

    Args:
        text: what people should know.
        level: how important it is, as `logging` has it.
    """
    prefix = priority_prefix(level) if is_journal(sys.stderr) else ""
    click.echo("\n".join(prefix + line for line in shown_lines(text).split("\n")), err=True)
