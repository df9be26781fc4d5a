"""`rigcal status`: the rig's state on one screen, or in full."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import click

from daemon.cli.client import STATUS_TIMEOUT_S, ask, client_options, utc
from daemon.cli.command import Command
from daemon.cli.lines.clock import clock_sentence, latency_sentence
from daemon.cli.lines.jobs import job_lines
from daemon.cli.lines.state import (
    channel_status,
    decoding_lines,
    gap_lines,
    gap_state_lines,
    model_lines,
    notice_lines,
    show_alarms,
    show_session,
    station_line,
    store_lines,
)
from daemon.cli.lines.summary import state_sentence, summary
from daemon.cli.terminal import Coloured, echo, echo_table
from daemon.host.safe_output import duration
from daemon.next_step import next_line

WIDTH = 100  # if the terminal's width is unknown


@click.command(cls=Command)
@click.option("--all", "everything", is_flag=True, help="Also show all links, channels and events.")
@click.option("--frames", is_flag=True, help="Show all, and every received CAN identifier with its rate in frames/s.")
@client_options
def status(everything: bool, frames: bool, **where: Any) -> Any:
    """Show the rig's state, its faults and the next step."""
    show = partial(_show_all, frames=frames) if everything or frames else _show
    told = ask(where, "status", show, STATUS_TIMEOUT_S)
    return told | {"summary": {"state": state_sentence(told), "next": next_line(told)}}


def _show(status: Mapping[str, Any]) -> None:
    for line in summary(status, shutil.get_terminal_size((WIDTH, 0)).columns):
        echo(line.text, **line.style)


def _show_all(status: Mapping[str, Any], *, frames: bool) -> None:
    acquisition = status["acquisition"]
    echo(f"rig {status['rig']} ({status['mode']}), store {status['store']}")
    show_alarms(status["alarms"])
    for line in (*notice_lines(status["notices"]), *store_lines(status), *gap_state_lines(acquisition)):
        echo(line)
    if status["clock"] is not None:
        clock = status["clock"]
        echo(f"the computer's clock, {duration(clock['age_s'])} ago: {clock_sentence(clock)}")
    _show_links(acquisition["links"])
    _show_channels(acquisition["channels"])
    if frames:
        _show_frames(acquisition["frames"])
    for line in (*map(station_line, acquisition["stations"]), *decoding_lines(acquisition["decoding"])):
        echo(line)
    if status["latency"] is not None:
        echo(f"latency of the station's fixes in {status['latency']['session']}: {latency_sentence(status['latency'])}")
    if status["session"]:
        show_session(status["session"])
    for line in job_lines(status):
        echo(line)
    models, gap = status["models"], status["gap"]
    for line in (*(model_lines(models) if models else ()), *(gap_lines(gap) if gap else ())):
        echo(line)
    for event in reversed(status["events"]):
        echo(f"{utc(event['utc_ns'])} {event['device']} {event['kind']}: {event['text']}")


def _show_links(links: Sequence[Mapping[str, Any]]) -> None:
    state = {None: "starting", True: Coloured("up", "green"), False: Coloured("down", "red")}
    rows = [
        [
            link["name"],
            state[link["up"]],
            duration(link["since_s"]),
            str(link["captures"]),
            f"{link['captures_per_s']:.0f}",
            str(link["queued"]),
            str(link["dropped"]),
        ]
        for link in links
    ]
    header = ("link", "state", "for", "captures", "per s", "queued", "dropped")
    echo_table(header, rows, title="links", text_columns=(0, 1))


def _show_channels(channels: Sequence[Mapping[str, Any]]) -> None:
    rows = [
        [
            channel["name"],
            "" if channel["value"] is None else f"{channel['value']:.3f} {channel['unit']}",
            Coloured(channel_status(channel), "green" if channel["status"] == "ok" else "red"),
            "never" if channel["age_s"] is None else f"{channel['age_s']:.1f}",
        ]
        for channel in channels
    ]
    echo_table(("channel", "value", "status", "age s"), rows, title="channels", text_columns=(0, 1, 2))


def _show_frames(frames: Sequence[Mapping[str, Any]]) -> None:
    rows = [
        [
            frame["link"],
            frame["identifier"],
            frame["names"],
            str(frame["count"]),
            "" if frame["rate_per_s"] is None else f"{frame['rate_per_s']:.0f}",
            "" if frame["age_s"] is None else f"{frame['age_s']:.1f}",
            "" if frame["missed"] is None else str(frame["missed"]),
        ]
        for frame in frames
    ]
    header = ("link", "identifier", "what", "frames", "per s", "age s", "missed")
    echo_table(header, rows, title="frames", text_columns=(0, 1, 2))
