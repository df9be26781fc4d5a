"""`rigcal hand`: moves a simulated rig in place of an operator's hands."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from daemon.cli.client import ask, client_options, socket_of
from daemon.cli.command import Command
from daemon.cli.terminal import echo
from daemon.control.protocol import request

_FRESH_S, _AGAIN_S = 5.0, 0.2


@click.group()
def hand() -> None:
    """Move a simulated rig by hand.

    For practice with a rig that was started with `rigcal run --sim --by-hand`.
    """


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
    """Drive joints to values in deg or mm.

    By default all joints are driven to the pose that an open guide asks for. Joints that are not named keep their
    positions. The command does not wait until the boom stands still.
    """
    socket = socket_of(where["socket"], where["config"])
    wanted = _wanted(places)
    pose = _here(socket, wanted) if wanted else _guided(request(socket, "guide.state")["guide"])
    return ask(where, "simulation.visit", lambda _: echo(f"the boom moves to {_told(pose)}"), poses=[pose])


def _wanted(places: tuple[str, ...]) -> dict[str, float]:
    """Return joint -> value of JOINT=VALUE arguments."""
    wanted = {}
    for place in places:
        name, _, number = place.partition("=")
        if name in wanted:
            raise click.BadParameter(f"{name} is given twice", param_hint="JOINT=VALUE")
        try:
            wanted[name] = float(number)
        except ValueError:
            raise click.BadParameter(f"{place!r}: write it as theta1=30", param_hint="JOINT=VALUE") from None
    return wanted


def _here(socket: Path, wanted: Mapping[str, float]) -> dict[str, float]:
    """Return the current pose of the boom, with the wanted values replaced."""
    from calibration.rig.description import parse_rig

    shown = request(socket, "rig.show")
    joints = parse_rig(shown["text"], shown["rig"]).joints
    names = [joint.name for joint in joints]
    if unknown := [name for name in wanted if name not in names]:
        raise click.BadParameter(f"there is no joint {unknown[0]!r}; known: {', '.join(names)}", param_hint="JOINT")
    read = _read(socket, [name for name in names if name not in wanted])
    pose = {}
    for joint in joints:
        low, high = joint.limits  # a joint at its stop may read a little beyond its limit
        pose[joint.column] = wanted[joint.name] if joint.name in wanted else min(max(read[joint.name], low), high)
    return pose


def _read(socket: Path, names: Sequence[str]) -> dict[str, float]:
    """Return the readings of joints; retry, as a busy computer may have no fresh reading for a moment."""
    read: dict[str, float] = {}
    until = time.monotonic() + _FRESH_S
    while True:
        channels = request(socket, "status")["acquisition"]["channels"]
        read |= {c["name"]: c["value"] for c in channels if c["name"] in names and c["value"] is not None}
        missing = [name for name in names if name not in read]
        if not missing:
            return read
        if time.monotonic() > until:
            raise click.ClickException(f"joint {missing[0]} has no reading; also give its value")
        time.sleep(_AGAIN_S)


def _guided(guide: Mapping[str, Any] | None) -> dict[str, float]:
    """Return the pose that an open guide asks for."""
    joints = guide["joints"] if guide is not None and guide["state"] == "open" else []
    if not joints or any(joint["target"] is None for joint in joints):
        raise click.UsageError("no guide asks for a pose now; name joints with their values, such as theta1=30")
    return {f"{joint['name']}_{joint['unit']}": joint["target"] for joint in joints}


def _told(pose: Mapping[str, float]) -> str:
    return ", ".join(f"{column} {value:.1f}" for column, value in pose.items())
