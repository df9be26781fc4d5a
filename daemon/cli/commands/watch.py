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

from daemon.cli.client import STATUS_TIMEOUT_S, client_options, socket_of
from daemon.cli.command import Command, stream_json
from daemon.cli.lines.jobs import job_lines
from daemon.cli.lines.summary import LINES, Line, reading, state_sentence, summary
from daemon.cli.terminal import begin_screen, draw_screen, echo, end_screen
from daemon.commands import CommandError
from daemon.control.protocol import request

WIDTH = 100


@click.command(cls=Command)
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(0.2, 3600),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="Time between updates.",
)
@click.option("--count", type=click.IntRange(min=1), help="End after this many updates; no end by default.")
@client_options
def watch(interval_s: float, count: int | None, **where: Any) -> None:
    """Show the rig's state continuously until Ctrl-C.

    The state has alarms, joints, station, rates, open session and jobs. On a terminal the screen is updated. Otherwise
    each update is one line, with --json one object. If the daemon does not answer, this is shown, and the connection is
    retried.
    """
    is_screen = sys.stdout.isatty() and not where["as_json"]
    socket = socket_of(where["socket"], where["config"])
    looks = itertools.count() if count is None else range(count)
    if is_screen:
        begin_screen()
    try:
        for look in looks:
            if look:
                time.sleep(interval_s)
            status, fault = _look(socket)
            if is_screen:
                _draw(status, fault)
            elif where["as_json"]:
                stream_json({"error": fault} if status is None else status)
            else:
                echo(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} {fault if status is None else one_line(status)}")
            sys.stdout.flush()
    except KeyboardInterrupt:
        pass
    finally:
        if is_screen:
            end_screen()
    raise click.exceptions.Exit(0)  # there is no final result to print


def one_line(status: Mapping[str, Any]) -> str:
    """Return the state in one line."""
    acquisition, alarms = status["acquisition"], status["alarms"]["active"]
    parts = [state_sentence(status)]
    parts += [
        f"{channel['name']} {reading(channel)}" for channel in acquisition["channels"] if channel["kind"] == "joint"
    ]
    parts += [f"{station['name']}: {station['sentence']}" for station in acquisition["stations"]]
    parts += job_lines(status)
    named = ", ".join(f"{alarm['kind']} {alarm['subject']}" for alarm in alarms)
    parts.append(f"alarms: {named}" if alarms else "no alarms")
    return "; ".join(parts)


def _look(socket: Any) -> tuple[Mapping[str, Any] | None, str]:
    """Return the daemon's state, or None with the reason if it does not answer."""
    try:
        return request(socket, "status", timeout_s=STATUS_TIMEOUT_S), ""
    except CommandError as error:
        return None, f"connection lost, retrying: {error}"


def _draw(status: Mapping[str, Any] | None, fault: str) -> None:
    columns, rows = shutil.get_terminal_size((WIDTH, LINES + 1))
    lines = [Line(fault, {"fg": "red", "bold": True})]
    if status is not None:
        lines = summary(status, columns, rows - 2, with_joints=True)[: rows - 2]
    draw_screen([*lines, Line(f"{datetime.now(UTC):%H:%M:%S} UTC, Ctrl-C ends", {"dim": True})])
