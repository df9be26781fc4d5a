"""`rigcal status`: the state of links, channels, station, sessions, jobs and models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import click

from daemon.cli.client import ask, client_options, utc
from daemon.cli.command import Command
from daemon.cli.state_lines import (
    decoding_lines,
    gap_lines,
    gap_state_lines,
    job_line,
    model_lines,
    notice_lines,
    show_alarms,
    show_session,
    station_line,
)
from daemon.cli.terminal import Coloured, echo, echo_table
from daemon.cli.time_lines import clock_sentence, latency_sentence


@click.command(cls=Command)
@click.option("--frames", is_flag=True, help="Also every CAN identifier that was heard, with its rate.")
@client_options
def status(frames: bool, **where: Any) -> Any:
    """Show the state of the rig's links, channels and station, and what is going on."""
    return ask(where, "status", partial(_show, frames=frames))


def _show(status: Mapping[str, Any], *, frames: bool) -> None:
    acquisition = status["acquisition"]
    echo(f"rig {status['rig']} ({status['mode']}), store {status['store']}")
    show_alarms(status["alarms"])
    for line in (*notice_lines(status["notices"]), *_store_lines(status), *gap_state_lines(acquisition)):
        echo(line)
    if status["clock"] is not None:
        echo(f"the computer's clock: {clock_sentence(status['clock'])}")
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
    for line in map(job_line, status["jobs"]):
        echo(line)
    models, gap = status["models"], status["gap"]
    for line in (*(model_lines(models) if models else ()), *(gap_lines(gap) if gap else ())):
        echo(line)
    for event in reversed(status["events"]):
        echo(f"{utc(event['utc_ns'])} {event['device']} {event['kind']}: {event['text']}")


def _store_lines(status: Mapping[str, Any]) -> Iterator[str]:
    """Return the store's present work and its unreadable parts; its faults are alarms."""
    if status["store_health"]["state"] == "checking":
        yield status["store_health"]["text"]
    if status["acquisition"]["is_behind"]:
        yield "captures wait to be decoded: readings and fixes come late, and jobs wait"
    for part, reason in status["unreadable"].items():
        yield f"{part}: cannot be read from the store ({reason})"


def _show_links(links: Sequence[Mapping[str, Any]]) -> None:
    state = {None: "starting", True: Coloured("up", "green"), False: Coloured("down", "red")}
    rows = [
        [
            link["name"],
            state[link["up"]],
            str(link["captures"]),
            f"{link['captures_per_s']:.0f}",
            str(link["queued"]),
            str(link["dropped"]),
        ]
        for link in links
    ]
    echo_table(("link", "state", "captures", "per s", "queued", "dropped"), rows, title="links", text_columns=(0, 1))


def _show_channels(channels: Sequence[Mapping[str, Any]]) -> None:
    rows = [
        [
            channel["name"],
            "" if channel["value"] is None else f"{channel['value']:.3f} {channel['unit']}",
            Coloured(channel["status"].replace("_", " "), "green" if channel["status"] == "ok" else "red"),
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
            "" if frame["missed"] is None else str(frame["missed"]),
        ]
        for frame in frames
    ]
    header = ("link", "identifier", "what", "frames", "per s", "missed")
    echo_table(header, rows, title="frames", text_columns=(0, 1, 2))
