"""`rigcal alarms`: active alarms and their remedies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.state_lines import cleared_line, show_alarms
from daemon.cli.terminal import echo


@click.command(cls=Command)
@click.option("--all", "everything", is_flag=True, help="Also those that are over, newest first.")
@client_options
def alarms(everything: bool, **where: Any) -> Any:
    """Show what is wrong now, since when, and what to do about it."""
    return ask(where, "alarms.list", _show, all=everything)


def _show(found: Mapping[str, Any]) -> None:
    show_alarms(found)
    for alarm in found["cleared"]:
        echo(cleared_line(alarm))
