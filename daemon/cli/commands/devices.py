"""`rigcal devices`: CANopen devices of the rig."""

from __future__ import annotations

from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.terminal import echo


@click.group()
def devices() -> None:
    """CANopen devices of the rig."""


@devices.command(cls=Command, name="configure")
@click.option("--machine-is-parked", is_flag=True, help="The machine is parked and locked out.")
@client_options
def devices_configure(machine_is_parked: bool, **where: Any) -> Any:
    """Check identity and resolution of the encoders, set their transmission, and start them.

    Needs a link with allow_transmit = true that lists the nodes.
    """
    return ask(where, "devices.configure", lambda result: echo(result["text"]), machine_is_parked=machine_is_parked)
