"""`rigcal plan`: which poses to measure."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from calibration.rig import Rig
from daemon.cli.options import rig_option, seed_option
from daemon.cli.output import Command, json_option, progress_display
from daemon.cli.tables import say
from daemon.cli.terminal import Terminal
from daemon.files import write_file
from daemon.numba_cache import prepare
from daemon.report.markup import number
from daemon.rigs import load_rig

if TYPE_CHECKING:
    from calibration.design.planning import PosePlan, PoseRow

_MOST_POSES = 1000
_MOST_EFFECTS = 3
_WIDEST = 1000
_LIST_SEPARATOR = " "


@click.command(cls=Command)
@rig_option
@click.option(
    "--model",
    "directory",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="A model of the rig: plan what else to measure, at its set-up.",
)
@click.option(
    "--separate",
    metavar="FAMILY@WHERE,FAMILY@WHERE[,...]",
    help="Tell these effects apart, two or three, e.g. joint_compliance@theta4,encoder_harmonic@theta4.",
)
@click.option("--poses", type=click.IntRange(1, _MOST_POSES), required=True, metavar="N", help="How many poses.")
@click.option(
    "--station",
    metavar="X,Y,Z",
    help="Where the total station stands, mm in the rig's base frame; a new set-up. By default the model's place, or "
    "without a model one about the base from where most is seen.",
)
@click.option(
    "--setup", metavar="NAME", help="Which of the model's set-ups; by default the one whose base is known best."
)
@click.option(
    "--floor",
    "floor_mm",
    type=float,
    metavar="MM",
    help="Height of the floor over the base's origin; by default 15 % of the reach below it.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), metavar="CSV", help="Also write the poses to a file."
)
@seed_option
@json_option
def plan(
    rig: str,
    directory: Path | None,
    separate: str | None,
    poses: int,
    station: str | None,
    setup: str | None,
    floor_mm: float | None,
    out: Path | None,
    seed: int,
    *,
    as_json: bool,
) -> dict[str, object]:
    """Plan the poses of a calibration session.

    They are inside the joint limits, in view of the station, ordered for short motion, and chosen so that the rig's
    parameters come out best determined; with --model so that the model's expected error over the work volume falls
    most; with --separate so that two or three effects can be told apart. Where these need it, a pose also says from
    which side to come, how long to stand, what to carry, whether to measure on the move, or when.
    """
    prepare()
    from calibration.design.planning import plan_poses
    from daemon.modelfiles import read_model

    source = load_rig(rig)
    effects = _effects(separate, source.rig)
    place = _station(station)
    if floor_mm is not None and not np.isfinite(floor_mm):
        raise click.BadParameter(f"{floor_mm} is no height in mm", param_hint="--floor")
    if setup is not None and (directory is None or station is not None):
        raise click.BadParameter("it is one of a model's: give --model, and no --station", param_hint="--setup")
    model = None if directory is None else read_model(directory)
    with progress_display(as_json=as_json) as progress:
        planned = plan_poses(
            source.rig,
            poses,
            np.random.default_rng(seed),
            model=model,
            station_mm=place,
            setup=setup,
            floor_mm=floor_mm,
            separate=effects,
            progress=progress,
        )
    result = planned.as_dict()
    if out is not None:
        write_file(out, as_csv(planned.rows).encode("utf-8"))
        result["out"] = str(out)
    if not as_json:
        _show(Terminal(), planned, result)
    return result


def as_csv(rows: Sequence[PoseRow]) -> str:
    """The poses as a table: `pose`, a column for each joint and for each condition that matters, `prisms` by spaces."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0].as_dict()), lineterminator="\n")
    writer.writeheader()
    writer.writerows({**row.as_dict(), "prisms": _LIST_SEPARATOR.join(row.prisms)} for row in rows)
    return text.getvalue()


def _effects(text: str | None, rig: Rig) -> tuple[str, ...]:
    from calibration.effects.library import parse_effects

    if text is None:
        return ()
    try:
        found = [f"{family}@{where}" for family, where in parse_effects(text, rig)]
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--separate") from error
    if not 2 <= len(found) <= _MOST_EFFECTS:
        wanted = "two or three effects, as FAMILY@WHERE,FAMILY@WHERE"
        raise click.BadParameter(f"{text!r} is not {wanted}", param_hint="--separate")
    return tuple(found)


def _station(text: str | None) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    if text is None:
        return None
    try:
        place = np.array([float(part) for part in text.split(",")])
    except ValueError:
        place = np.empty(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise click.BadParameter(f"{text!r} is no place; give X,Y,Z in mm, e.g. 0,-6000,1600", param_hint="--station")
    return place


def _show(console: Console, planned: PosePlan, result: Mapping[str, Any]) -> None:
    units = {joint.column: joint for joint in planned.rig.joints}
    table = Table(
        title=f"Poses for {planned.rig.name}, deg and mm",
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    first = planned.rows[0]
    headings = ["pose", *(units[c].name for c in first.joints), *(c.replace("_dir", " from") for c in first.conditions)]
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("prisms", no_wrap=True)
    for row in planned.rows:
        values = [f"{v:.{1 if units[c].kind == 'revolute' else 0}f}" for c, v in row.joints.items()]
        conditions = [_condition(name, value) for name, value in row.conditions.items()]
        table.add_row(str(row.pose), *values, *conditions, _LIST_SEPARATOR.join(row.prisms))
    # A number that is cut short is no number: on a narrow terminal the lines wrap.
    needed = Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum
    Terminal(width=max(needed, console.width)).print(table)
    minutes, seconds = divmod(round(planned.plan.seconds_of_motion), 60)
    say(
        console,
        f"{result['fixes']} fixes; {minutes} min {seconds} s of motion with every joint at its full rate; "
        f"{result['determined']} of {result['parameters']} parameters determined by these poses",
    )
    spread = planned.after.spread
    say(
        console,
        f"Expected error of the model over the work volume afterwards, mm: mean {number(spread.mean_mm)}, "
        f"median {number(spread.median_mm)}, 95 % within {number(spread.p95_mm)}, 99 % within "
        f"{number(spread.p99_mm)}; {planned.after.where}",
    )
    for effect, sigma in result["stands_out_sigma"].items():
        say(console, f"{effect} of plausible size stands out from the others by {sigma:.1f} sigma")
    for title, sentences in (
        ("What else", result["advice"]),
        ("Please note", result["warnings"]),
        ("Assumed", result["assumptions"]),
    ):
        if sentences:
            console.print(f"{title}:", style="bold", highlight=False)
        for sentence in sentences:
            say(console, f"  - {sentence}")
    if "out" in result:
        say(console, f"Poses: {result['out']}")


def _condition(name: str, value: float) -> str:
    if name.endswith("_dir"):
        return "below" if value == 1 else "above"
    return f"{value:g}"


COMMANDS = {"plan": plan}
