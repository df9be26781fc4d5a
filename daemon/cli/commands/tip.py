"""`rigcal tip`: the present position of a prism, predicted by the live model."""

from __future__ import annotations

import logging
import time
from typing import Any

import click

from daemon.cli.client import STATUS_TIMEOUT_S, client_options, socket_of
from daemon.cli.command import DONE, FAILED, Command, Delivered, stream_json
from daemon.cli.terminal import echo, echo_error
from daemon.control.protocol import request

FOLLOW_S = 0.2


@click.command(cls=Command)
@click.option("--prism", help="Name of the prism; the configured one ([tip] prism) by default.")
@click.option("--follow", is_flag=True, help="Show the position five times a second until Ctrl-C.")
@client_options
def tip(prism: str | None, *, follow: bool, **where: Any) -> Any:
    """Show the present position of a prism.

    The live model predicts it from the latest joint readings. The position is given in the base frame and, if the model
    knows the station's set-up, in the station's frame as it would measure the prism. If the position is unknown, the
    exit status is 1 and the reason says what to do; --follow continues. With --follow and --json, each line of standard
    output is one object.
    """
    arguments = {} if prism is None else {"prism": prism}
    socket = socket_of(where["socket"], where["config"])
    if not follow:
        result = request(socket, "tip", arguments, timeout_s=STATUS_TIMEOUT_S)
        is_known = result["base_mm"] is not None
        if is_known and not where["as_json"]:
            _show(result)
        if not is_known:
            echo_error(f"Error: {_unknown(result)}", logging.ERROR)
        return Delivered(result, DONE if is_known else FAILED)
    try:
        while True:
            result = request(socket, "tip", arguments, timeout_s=STATUS_TIMEOUT_S)
            if where["as_json"]:
                stream_json(result)
            else:
                _show(result)
            time.sleep(FOLLOW_S)
    except KeyboardInterrupt:
        raise click.exceptions.Exit(0) from None


def _show(tip: dict[str, Any]) -> None:
    if tip["base_mm"] is None:
        echo(_unknown(tip))
        return
    line = f"prism {tip['prism']}: base {_place(tip['base_mm'])} mm, sigma {tip['sigma_mm']:.1f} mm"
    if tip["setup"] is None:
        line += "; not in a station's frame: the model does not know the station's set-up"
    else:
        line += f"; station {tip['setup']} {_place(tip['station_mm'])} mm"
    echo(f"{line}; {tip['age_s']:.2f} s ago, model {tip['model']}, {tip['status']}")
    for warning in tip["warnings"]:
        echo(f"  note: {warning}")


def _unknown(tip: dict[str, Any]) -> str:
    remedy = "; `rigcal status` shows the next step to a live model" if tip["status"] == "no_model" else ""
    status = "" if tip["status"] == "no_model" else f"{tip['status'].replace('_', ' ')}: "
    return f"prism {tip['prism']}: {status}{tip['reason']}{remedy}"


def _place(place: list[float]) -> str:
    return " ".join(f"{value:.1f}" for value in place)
