"""`rigcal tip`: where a prism is now, by the live model."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click
from rich.console import Console

from daemon.cli.output import Command
from daemon.cli.talk import say, socket_of, talks
from daemon.cli.terminal import Terminal
from daemon.control import request

FOLLOW_S = 0.2


@click.command(cls=Command)
@click.option("--prism", help="Which prism; the configured one ([tip] prism) by default.")
@click.option("--follow", is_flag=True, help="Again and again, five times a second, until stopped.")
@talks
def tip(prism: str | None, *, follow: bool, **where: Any) -> Any:
    """Where a prism is now: the joints' latest readings through the live model.

    In the base frame, and in the station's, as it would measure the prism, where its set-up is known to the model.
    Where the place is not known, the status says why. With --follow and --json, standard output holds one object a
    line.
    """
    arguments = {} if prism is None else {"prism": prism}
    socket = socket_of(where["socket"], where["config"])
    if not follow:
        result = request(socket, "tip", arguments)
        if not where["as_json"]:
            _show(Terminal(), result)
        return result
    try:
        while True:
            result = request(socket, "tip", arguments)
            if where["as_json"]:
                # A command's standard output is kept for its one result; here each line is one.
                click.echo(json.dumps(result), file=sys.__stdout__)
            else:
                _show(Terminal(), result)
            time.sleep(FOLLOW_S)
    except KeyboardInterrupt:
        raise click.exceptions.Exit(0) from None


def _show(console: Console, tip: dict[str, Any]) -> None:
    if tip["base_mm"] is None:
        say(console, f"prism {tip['prism']}: {tip['status']}: {tip['reason']}")
        return
    line = f"prism {tip['prism']}: base {_place(tip['base_mm'])} mm, sigma {tip['sigma_mm']:.1f} mm"
    if tip["setup"] is not None:
        line += f"; station {tip['setup']} {_place(tip['station_mm'])} mm"
    say(console, f"{line}; {tip['age_s']:.2f} s ago, model {tip['model']}, {tip['status']}")
    for warning in tip["warnings"]:
        say(console, f"  note: {warning}")


def _place(place: list[float]) -> str:
    return " ".join(f"{value:.1f}" for value in place)


COMMANDS = {"tip": tip}
