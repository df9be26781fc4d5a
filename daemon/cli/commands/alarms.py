"""`rigcal alarms`: active alarms and their remedies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.lines.state import cleared_line, show_alarms
from daemon.cli.terminal import echo


@click.command(cls=Command)
@click.option("--all", "everything", is_flag=True, help="Also show cleared alarms, newest first.")
@click.option("--send-test", is_flag=True, help="Send a test notice to all targets of notices ([notify]).")
@client_options
def alarms(everything: bool, send_test: bool, **where: Any) -> Any:
    """Show the active alarms, their age and their remedies."""
    if send_test:
        return ask(where, "alarms.test-notice", echo)
    return ask(where, "alarms.list", _show, all=everything)


def _show(found: Mapping[str, Any]) -> None:
    show_alarms(found)
    for alarm in found["cleared"]:
        echo(cleared_line(alarm))
