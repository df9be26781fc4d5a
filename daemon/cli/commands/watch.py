"""`rigcal watch`: the rig's state, live in the terminal."""

from __future__ import annotations

import itertools
import shutil
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import click

from daemon.cli.client import client_options, socket_of
from daemon.cli.command import Command
from daemon.cli.job_lines import job_line
from daemon.cli.summary import LINES, reading, state_sentence, summary
from daemon.cli.terminal import echo
from daemon.commands import CommandError
from daemon.control.protocol import request
from daemon.host.safe_output import json_line

WIDTH = 100
TIMEOUT_S = 10.0
# xterm's sequences: another screen without a cursor, its first place, and back to the terminal as it was.
_BEGIN, _HOME, _END = "\x1b[?1049h\x1b[?25l", "\x1b[H", "\x1b[?25h\x1b[?1049l"
_REST_OF_LINE, _REST_OF_SCREEN = "\x1b[K", "\x1b[J"


@click.command(cls=Command)
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(0.2, 3600),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="Between two looks.",
)
@click.option("--count", type=click.IntRange(min=1), help="End after so many looks; goes on until Ctrl-C by default.")
@client_options
def watch(interval_s: float, count: int | None, **where: Any) -> None:
    """Show joints, station, rates, open session, alarms and jobs, again and again until Ctrl-C.

    On a terminal the screen is refreshed. Elsewhere each look is one line, with --json one object. A daemon that does
    not answer is said to be lost, and asked again.
    """
    is_screen = sys.stdout.isatty() and not where["as_json"]
    socket = socket_of(where["socket"], where["config"])
    looks = itertools.count() if count is None else range(count)
    if is_screen:
        click.echo(_BEGIN, nl=False)
    try:
        for look in looks:
            if look:
                time.sleep(interval_s)
            status, fault = _look(socket)
            if is_screen:
                _draw(status, fault)
            elif where["as_json"]:
                line = json_line({"error": fault} if status is None else status)
                click.echo(line, file=sys.__stdout__)  # a command's standard output is kept for its one result
            else:
                echo(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} {fault if status is None else one_line(status)}")
            sys.stdout.flush()
    except KeyboardInterrupt:
        pass
    finally:
        if is_screen:
            click.echo(_END, nl=False)
    raise click.exceptions.Exit(0)  # nothing is left to be printed as the one result


def one_line(status: Mapping[str, Any]) -> str:
    """Return the state in one line."""
    acquisition, alarms = status["acquisition"], status["alarms"]["active"]
    parts = [state_sentence(status)]
    parts += [
        f"{channel['name']} {reading(channel)}" for channel in acquisition["channels"] if channel["kind"] == "joint"
    ]
    parts += [f"{station['name']}: {station['sentence']}" for station in acquisition["stations"]]
    parts += [job_line(job) for job in status["jobs"]]
    named = ", ".join(f"{alarm['kind']} {alarm['subject']}" for alarm in alarms)
    parts.append(f"alarms: {named}" if alarms else "no alarms")
    return "; ".join(parts)


def _look(socket: Any) -> tuple[Mapping[str, Any] | None, str]:
    """Return the daemon's state; None with the reason where it does not answer."""
    try:
        return request(socket, "status", timeout_s=TIMEOUT_S), ""
    except CommandError as error:
        return None, f"connection lost, trying again: {error}"


def _draw(status: Mapping[str, Any] | None, fault: str) -> None:
    """Write over the screen from its first line on, so that nothing flickers."""
    columns, rows = shutil.get_terminal_size((WIDTH, LINES + 1))
    lines = [click.style(fault, fg="red", bold=True)]
    if status is not None:
        told = summary(status, columns, rows - 2, with_joints=True)
        lines = [click.style(line.text, **line.style) for line in told[: rows - 2]]
    lines.append(click.style(f"{datetime.now(UTC):%H:%M:%S} UTC, Ctrl-C ends", dim=True))
    click.echo(_HOME + "".join(f"{line}{_REST_OF_LINE}\r\n" for line in lines) + _REST_OF_SCREEN, nl=False)
