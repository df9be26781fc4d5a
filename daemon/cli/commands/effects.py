"""`rigcal effects`: the library of effects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import Command, json_option
from daemon.cli.terminal import echo, echo_table

if TYPE_CHECKING:
    from calibration.effects.base import Family
    from calibration.effects.context import EffectContext
    from calibration.rig.description import Rig

_DEFAULT_RIG = "swdt82"
_SESSION_S = 4 * 3600.0
_PLACES_SHOWN = 4
_NOTHING: Mapping[str, Any] = {"name": "", "unit": "", "sigma": None, "lower": None, "upper": None}
_STEP_TIME = "time_s"  # has no plausible size, as a step may be anywhere in a session


@click.command(cls=Command)
@click.argument("name", required=False)
@click.option(
    "--rig",
    default=_DEFAULT_RIG,
    show_default=True,
    metavar="RIG",
    help="Name of a shipped rig, or path of a rig file, for places and plausible sizes.",
)
@json_option
def effects(name: str | None, rig: str, *, as_json: bool) -> dict[str, object]:
    """List the library of effects, or describe effect NAME.

    Shows the equation of each effect, its source, its coefficients with unit, plausible size (1 sigma) and hard bounds,
    the data that it needs, effects that it is confused with, and measurements that reveal it. Places and sizes depend
    on the rig.
    """
    from calibration.effects.library import library
    from daemon.rig_files import load_rig

    found = load_rig(rig).rig
    if name is not None and name not in library():
        raise click.BadParameter(f"{name!r} is unknown; known: {', '.join(library())}", param_hint="NAME")
    context = measured_everything(found)
    families = [described(library()[one], context) for one in ([name] if name else library())]
    result: dict[str, object] = {"rig": found.name, "effects": families}
    if not as_json:
        if name is None:
            _show_all(found.name, families)
        else:
            _show_one(found.name, families[0])
    return result


def measured_everything(rig: Rig) -> EffectContext:
    """Return the nominal rig in poses over its work volume, with all prisms and all optional columns measured."""
    from dataclasses import replace

    import numpy as np

    from calibration.effects.context import EffectContext
    from calibration.kinematics.chain import Chain, Placement
    from calibration.observations import Observations

    chain = Chain(rig, {"": Placement.identity()})
    none, blank = np.empty(0, dtype=np.str_), np.empty((0, 3))
    no_rows = Observations(none, {j.name: np.empty(0) for j in rig.joints}, blank, blank, none, none, none)
    volume = EffectContext(chain, np.zeros(len(chain)), no_rows).work_volume
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


def described(family: Family, context: EffectContext) -> dict[str, Any]:
    """Describe a family of effects, with the coefficients of its simplest form at each place of a rig."""
    places = []
    for where in family.places(context.rig):
        variants = family.variants(context, where)
        coefficients = _coefficients(family, context, where, variants[0]) if variants else []
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
    family: Family, context: EffectContext, where: str, settings: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Return the coefficients as in outputs; without bounds if these follow from other coefficients."""
    from calibration.effects.base import FittedCoefficient

    fitted = family.coefficients(context, where, settings)
    bounds = {c.name: (c.lower, c.upper) for c in fitted} | dict(family.reported_limits())
    listed = family.reported(settings, tuple(FittedCoefficient(c.name, c.unit, 0.0, 0.0, c.sigma) for c in fitted))
    return [
        {"name": c.name, "unit": c.unit, "sigma": None if c.name == _STEP_TIME else c.prior_sigma}
        | dict(zip(("lower", "upper"), bounds.get(c.name, (None, None)), strict=True))
        for c in listed
    ]


def _show_all(rig: str, families: Sequence[Mapping[str, Any]]) -> None:
    rows = []
    for family in families:
        places = [p for p in family["places"] if p["coefficients"]]
        cells = [family["family"], _some([p["where"] for p in places])]
        for c in places[0]["coefficients"] if places else [_NOTHING]:
            rows.append([*cells, c["name"], _number(c["sigma"]), _number(c["upper"]), c["unit"]])
            cells = ["", ""]
    header = ("effect", "where", "coefficients", "plausible", "bound", "unit")
    echo_table(header, rows, title=f"Effects that rigcal can name, and their places in {rig}")
    echo("Sizes are for the first place. `rigcal effects NAME` shows all about one effect.")


def _show_one(rig: str, family: Mapping[str, Any]) -> None:
    echo(family["family"], bold=True)
    echo(f"  {family['equation']}")
    echo(f"  source: {family['source']}")
    echo(f"  confused with: {', '.join(family['confused_with']) or 'nothing in the library'}")
    echo(f"  revealed by: {family['revealed_by']}")
    if not family["places"]:
        echo(f"  rig {rig} has no place for it")
        return
    rows = []
    for place in family["places"]:
        where = place["where"]
        for c in place["coefficients"] or [_NOTHING]:
            rows.append([where, c["name"], *(_number(c[key]) for key in ("sigma", "lower", "upper")), c["unit"]])
            where = ""
    header = ("where", "coefficient", "plausible", "lower bound", "upper bound", "unit")
    echo_table(header, rows, title=f"Places in {rig}")
    for needs, where in _needs(family["places"]).items():
        echo(f"  needs at {where}: {needs}")


def _needs(places: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return required data -> places; a joint's name in the requirement is replaced by `<joint>`."""
    found: dict[str, list[str]] = {}
    for place in places:
        if place["needs"]:
            found.setdefault(place["needs"].replace(f"{place['where']}_", "<joint>_"), []).append(place["where"])
    return {needs: ", ".join(where) for needs, where in found.items()}


def _some(places: Sequence[str]) -> str:
    """Return the places of a family; if there are many, only the first and the last."""
    if len(places) > _PLACES_SHOWN:
        return f"{places[0]} .. {places[-1]} ({len(places)})"
    return " ".join(places) or "nowhere in this rig"


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.3g}"
