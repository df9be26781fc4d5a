"""`rigcal setup`: station set-ups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from daemon.cli.client import ask, client_options
from daemon.cli.command import Command
from daemon.cli.terminal import echo, echo_table


@click.group()
def setup() -> None:
    """Record and list set-ups of the total station."""


@setup.command(cls=Command, name="new")
@click.argument("name")
@click.option("--instrument", default="", help="Maker and model.")
@click.option("--serial", default="", help="Serial number.")
@click.option("--tilt-arcsec", type=float, help="Residual tilt shown after levelling, arcsec.")
@click.option("--ppm", type=float, help="Atmospheric correction set on the instrument, ppm.")
@click.option(
    "--prism-constant",
    multiple=True,
    metavar="PRISM=MM",
    help="Prism constant set on the instrument for a prism, mm. May be repeated.",
)
@click.option(
    "--control-point",
    multiple=True,
    metavar="NAME=X,Y,Z",
    help="Known position of a control point in the station's frame, mm; by default its first shot defines it. May be "
    "repeated.",
)
@click.option("--note", default="", help="Remark, stored with the set-up.")
@client_options
def setup_new(prism_constant: tuple[str, ...], control_point: tuple[str, ...], **options: Any) -> Any:
    """Record a new set-up, NAME, whenever the station was moved."""
    where = {key: options.pop(key) for key in ("socket", "config", "as_json")}
    constants = _assignments("--prism-constant", prism_constant, "r=-30", 1)
    return ask(
        where,
        "setup.new",
        lambda result: echo(f"set-up {result['id']} is in use"),
        id=options.pop("name"),
        prism_constants_mm={prism: mm for prism, (mm,) in constants.items()},
        control_points=_assignments("--control-point", control_point, "cp1=12000,3500,1800", 3),
        **options,
    )


def _assignments(option: str, texts: tuple[str, ...], example: str, count: int) -> dict[str, list[float]]:
    """Parse NAME=NUMBER,... options with `count` numbers each."""
    result = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        try:
            result[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            result[name] = []
        if len(result[name]) != count:
            raise click.BadParameter(f"{text!r}: write it as {example}", param_hint=option)
    return result


@setup.command(cls=Command, name="list")
@client_options
def setup_list(**where: Any) -> Any:
    """List all set-ups with their control points."""
    return ask(where, "setup.list", _show)


def _show(setups: Sequence[Mapping[str, Any]]) -> None:
    if not setups:
        echo("no set-ups yet; `rigcal setup new` records one")
        return
    rows = []
    for setup in setups:
        points = ", ".join(point["name"] for point in setup["control_points"])
        tilt, ppm = ("" if setup[key] is None else f"{setup[key]:g}" for key in ("tilt_arcsec", "ppm"))
        rows.append([setup["id"], setup["instrument"], setup["state"], tilt, ppm, points])
    echo_table(("set-up", "instrument", "state", "tilt arcsec", "ppm", "control points"), rows)
