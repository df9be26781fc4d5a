"""`rigcal devices`: the rig's CANopen devices."""

from __future__ import annotations

from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.terminal import echo


@click.group()
def devices() -> None:
    """Set up CANopen devices of the rig."""


@devices.command(cls=Command, name="configure")
@click.option("--machine-is-parked", is_flag=True, help="Confirm that the machine is parked and locked out.")
@client_options
def devices_configure(machine_is_parked: bool, **where: Any) -> Any:
    """Check, configure and start the encoders.

    Identity and resolution are checked, and transmission is configured. Requires a link with allow_transmit = true.
    Only nodes in its transmit_nodes are set up.
    """
    return ask(where, "devices.configure", lambda result: echo(result["text"]), machine_is_parked=machine_is_parked)
