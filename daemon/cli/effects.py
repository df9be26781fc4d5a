"""`rigcal effects`: the physics that rigcal can name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from daemon.cli.output import Command, json_option
from daemon.cli.tables import say
from daemon.cli.terminal import Terminal
from daemon.rigs import load_rig

if TYPE_CHECKING:
    from calibration.effects.base import Family, Situation
    from calibration.rig import Rig

_DEFAULT_RIG = "swdt82"
_SESSION_S = 4 * 3600.0
_WIDEST = 1000
_PLACES_SHOWN = 4
_NOTHING: Mapping[str, Any] = {"name": "", "unit": "", "sigma": None, "lower": None, "upper": None}
_STEP_TIME = "time_s"  # a step may be anywhere in a session


@click.command(cls=Command)
@click.argument("name", required=False)
@click.option(
    "--rig",
    default=_DEFAULT_RIG,
    show_default=True,
    metavar="RIG",
    help="Name of a shipped rig, or path of a rig file: places and plausible sizes are a rig's.",
)
@json_option
def effects(name: str | None, rig: str, *, as_json: bool) -> dict[str, object]:
    """The library of effects, or one of them, NAME, in full.

    What each does, where it is from, its coefficients with unit, plausible size (1 sigma) and hard bounds, what data it
    needs, what it is confused with, and what reveals it. Places and sizes are those of a rig.
    """
    from calibration.effects.library import library

    found = load_rig(rig).rig
    if name is not None and name not in library():
        raise click.BadParameter(f"{name!r} is unknown; there are {', '.join(library())}", param_hint="NAME")
    situation = measured_everything(found)
    families = [described(library()[one], situation) for one in ([name] if name else library())]
    result: dict[str, object] = {"rig": found.name, "effects": families}
    if not as_json:
        console = Terminal()
        if name is None:
            _show_all(console, found.name, families)
        else:
            _show_one(console, found.name, families[0])
    return result


def measured_everything(rig: Rig) -> Situation:
    """The nominal rig in poses spread over its work volume, every prism and every optional column measured."""
    from dataclasses import replace

    from calibration.effects.base import Situation
    from calibration.kinematics import Chain, Placement

    chain = Chain(rig, {"": Placement.identity()})
    volume = Situation(chain, np.zeros(len(chain)), _no_rows(rig)).work_volume
    rows = np.tile(np.arange(len(volume)), len(rig.prism_names))
    observations = replace(
        volume.observations.select(rows), prism=np.repeat(np.array(rig.prism_names, dtype=np.str_), len(volume))
    )
    ramp = np.linspace(0.0, 1.0, len(rows))
    side = np.where(np.arange(len(rows)) % 2 == 0, 1.0, -1.0)
    extra = {"time_s": _SESSION_S * ramp, "dwell_s": 60.0 * ramp, "temperature_degC": 10.0 + 10.0 * ramp}
    extra["payload_kg"] = np.where(side > 0.0, 100.0, 0.0)
    for joint in rig.joints:
        extra |= {f"{joint.name}_dir": side, f"{joint.name}_rate": side, f"{joint.name}_bar": 100.0 * (1.0 + ramp)}
    return replace(volume, observations=replace(observations, extra=extra))


def described(family: Family, situation: Situation) -> dict[str, Any]:
    """All that a family says of itself, with what its simplest form has at each place of a rig."""
    places = []
    for where in family.places(situation.rig):
        variants = family.variants(situation, where)
        coefficients = _coefficients(family, situation, where, variants[0]) if variants else []
        places.append({"where": where, "needs": family.needs(where), "coefficients": coefficients})
    return {
        "family": family.name,
        "equation": family.equation,
        "source": family.source,
        "confused_with": list(family.confused_with),
        "revealed_by": family.revealed_by,
        "places": places,
    }


def _coefficients(
    family: Family, situation: Situation, where: str, settings: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Coefficients as outputs list them; no bounds where they follow from others."""
    from calibration.effects.base import FittedCoefficient

    fitted = family.coefficients(situation, where, settings)
    bounds = {c.name: (c.lower, c.upper) for c in fitted} | dict(family.reported_limits())
    listed = family.reported(settings, tuple(FittedCoefficient(c.name, c.unit, 0.0, 0.0, c.sigma) for c in fitted))
    return [
        {"name": c.name, "unit": c.unit, "sigma": None if c.name == _STEP_TIME else c.prior_sigma}
        | dict(zip(("lower", "upper"), bounds.get(c.name, (None, None)), strict=True))
        for c in listed
    ]


def _no_rows(rig: Rig) -> Any:
    from calibration.observations import Observations

    none, blank = np.empty(0, dtype=np.str_), np.empty((0, 3))
    return Observations(none, {j.name: np.empty(0) for j in rig.joints}, blank, blank, none, none, none)


def _show_all(console: Console, rig: str, families: Sequence[Mapping[str, Any]]) -> None:
    table = _table(
        f"Effects that rigcal can name, and where in {rig}",
        ("effect", "where", "coefficients", "plausible", "bound", "unit"),
    )
    for family in families:
        places = [p for p in family["places"] if p["coefficients"]]
        cells = [family["family"], _some([p["where"] for p in places])]
        for c in places[0]["coefficients"] if places else [_NOTHING]:
            table.add_row(*cells, c["name"], _number(c["sigma"]), _number(c["upper"]), c["unit"])
            cells = ["", ""]
    _print_whole(console, table)
    say(console, "Sizes are those of the first place. `rigcal effects NAME` tells all of one.")


def _show_one(console: Console, rig: str, family: Mapping[str, Any]) -> None:
    console.print(family["family"], style="bold", highlight=False, markup=False)
    say(console, f"  {family['equation']}")
    say(console, f"  source: {family['source']}")
    say(console, f"  confused with: {', '.join(family['confused_with']) or 'nothing in the library'}")
    say(console, f"  revealed by: {family['revealed_by']}")
    if not family["places"]:
        say(console, f"  rig {rig} has no place for it")
        return
    table = _table(f"Where in {rig}", ("where", "coefficient", "plausible", "lower bound", "upper bound", "unit"))
    for place in family["places"]:
        cells = [place["where"]]
        for c in place["coefficients"] or [_NOTHING]:
            numbers = [_number(c[key]) for key in ("sigma", "lower", "upper")]
            table.add_row(*cells, c["name"], *numbers, c["unit"])
            cells = [""]
    _print_whole(console, table)
    for needs, where in _needs(family["places"]).items():
        say(console, f"  needs at {where}: {needs}")


def _needs(places: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """What is needed, each place called by what it is -> where."""
    found: dict[str, list[str]] = {}
    for place in places:
        if place["needs"]:
            found.setdefault(place["needs"].replace(f"{place['where']}_", "<joint>_"), []).append(place["where"])
    return {needs: ", ".join(where) for needs, where in found.items()}


def _table(title: str, headings: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading, no_wrap=True)
    return table


def _print_whole(console: Console, table: Table) -> None:
    # A number that is cut short is no number: on a narrow terminal the lines wrap.
    needed = Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum
    Terminal(width=max(needed, console.width)).print(table)


def _some(places: Sequence[str]) -> str:
    """The places of a family, the middle ones left out where there are many."""
    if len(places) > _PLACES_SHOWN:
        return f"{places[0]} .. {places[-1]} ({len(places)})"
    return " ".join(places) or "nowhere in this rig"


def _number(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.3g}"


COMMANDS = {"effects": effects}
