"""`rigcal hand`: the hands of a simulated rig that is moved as an operator would move it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from daemon.cli.client import ask, client_options, socket_of
from daemon.cli.command import Command
from daemon.cli.terminal import echo
from daemon.control.protocol import request


@click.group()
def hand() -> None:
    """Move a simulated rig by hand: for practice with `rigcal run --sim --by-hand`."""


@hand.command(cls=Command)
@click.argument("target")
@client_options
def aim(target: str, **where: Any) -> Any:
    """Turn the station to TARGET, a prism or a control point."""
    return ask(where, "simulation.aim", lambda _: echo(f"the station is aimed at {target}"), target=target)


@hand.command(cls=Command)
@click.argument("places", nargs=-1, metavar="[JOINT=VALUE]...")
@client_options
def move(places: tuple[str, ...], **where: Any) -> Any:
    """Drive joints to values in deg or mm; without any, all joints to the pose that an open guide asks for.

    Joints that are not named stay where they are. The command does not wait until the boom stands.
    """
    socket = socket_of(where["socket"], where["config"])
    wanted = _wanted(places)
    if wanted:
        pose = _here(request(socket, "rig.show"), request(socket, "status"), wanted)
    else:
        pose = _guided(request(socket, "guide.state")["guide"])
    return ask(where, "simulation.visit", lambda _: echo(f"the boom goes to {_told(pose)}"), poses=[pose])


def _wanted(places: tuple[str, ...]) -> dict[str, float]:
    """Return joint -> value of JOINT=VALUE arguments."""
    wanted = {}
    for place in places:
        name, _, number = place.partition("=")
        try:
            wanted[name] = float(number)
        except ValueError:
            raise click.BadParameter(f"{place!r}: write it as theta1=30", param_hint="JOINT=VALUE") from None
    return wanted


def _here(shown: Mapping[str, Any], status: Mapping[str, Any], wanted: Mapping[str, float]) -> dict[str, float]:
    """Return the pose where the boom is, but for the joints that are wanted elsewhere."""
    from calibration.rig.description import parse_rig

    joints = parse_rig(shown["text"], shown["rig"]).joints
    names = [joint.name for joint in joints]
    if unknown := [name for name in wanted if name not in names]:
        raise click.BadParameter(f"there is no joint {unknown[0]!r}; there are {', '.join(names)}", param_hint="JOINT")
    values = {c["name"]: c["value"] for c in status["acquisition"]["channels"] if c["kind"] == "joint"}
    pose = {}
    for joint in joints:
        value = wanted.get(joint.name)
        if value is None:
            if values.get(joint.name) is None:
                raise click.ClickException(f"joint {joint.name} is not read: give its value, too")
            low, high = joint.limits  # a joint at its stop may read a little beyond
            value = min(max(float(values[joint.name]), low), high)
        pose[joint.column] = value
    return pose


def _guided(guide: Mapping[str, Any] | None) -> dict[str, float]:
    """Return the pose that an open guide asks for."""
    joints = guide["joints"] if guide is not None and guide["state"] == "open" else []
    if not joints or any(joint["target"] is None for joint in joints):
        raise click.UsageError("no guide asks for a pose now; name joints with their values, such as theta1=30")
    return {f"{joint['name']}_{joint['unit']}": joint["target"] for joint in joints}


def _told(pose: Mapping[str, float]) -> str:
    return ", ".join(f"{column} {value:.1f}" for column, value in pose.items())
