"""`rigcal plan`: plans the poses to measure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.offline import FiniteNumber, replaced, rig_option, seed_option
from daemon.cli.terminal import echo, echo_list, echo_table
from daemon.host.safe_output import write_file
from daemon.report.words import number
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.design.planning import PosePlan
    from calibration.observations import Floats
    from calibration.rig.description import Rig

_MOST_POSES = 1000
_MOST_EFFECTS = 3
_LIST_SEPARATOR = " "


@click.command(cls=Command)
@rig_option
@click.option(
    "--model",
    "directory",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Directory of a model of the rig: plan additional poses, at one of its set-ups.",
)
@click.option(
    "--separate",
    metavar="FAMILY@WHERE,FAMILY@WHERE[,...]",
    help="Distinguish these two or three effects, e.g. joint_compliance@theta4,encoder_harmonic@theta4.",
)
@click.option("--poses", type=click.IntRange(1, _MOST_POSES), required=True, metavar="N", help="Number of poses.")
@click.option(
    "--station",
    metavar="X,Y,Z",
    help="Position of the total station for a new set-up, mm in the rig's base frame. By default its position in the "
    "model, or without a model a position near the base with the best view.",
)
@click.option(
    "--setup", metavar="NAME", help="Set-up of the model; by default the one whose base is known most accurately."
)
@click.option(
    "--floor",
    "floor_mm",
    type=FiniteNumber(),
    metavar="MM",
    help="Height of the floor above the base's origin; by default 15 % of the reach below it.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), metavar="CSV", help="Also write the poses to this file."
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

    Poses are within the joint limits, visible from the station, and ordered for short motion. They are chosen so that
    the rig's parameters are determined as well as possible; with --model so that the expected error over the work
    volume decreases most; with --separate so that two or three effects can be distinguished. If effects need it, a pose
    also has the direction of approach, the dwell time, the payload, the time, or whether to measure on the move.
    """
    prepare()

    from calibration.design.planning import plan_poses
    from calibration.run_settings import Run
    from daemon.models.gap_files import poses_csv
    from daemon.models.model_files import read_model
    from daemon.rig_files import load_rig

    source = load_rig(rig)
    effects = _effects(separate, source.rig)
    place = _station(station)
    if setup is not None and (directory is None or station is not None):
        raise click.BadParameter("names a set-up of a model; give --model, and omit --station", param_hint="--setup")
    model = None if directory is None else read_model(directory)
    with progress_display(as_json=as_json) as progress:
        planned = plan_poses(
            source.rig,
            poses,
            model=model,
            station_mm=place,
            setup=setup,
            floor_mm=floor_mm,
            separate=effects,
            run=Run(seed, progress=progress),
        )
    result, note = planned.as_dict(), ""
    if out is not None:
        note = replaced(out)
        write_file(out, poses_csv([row.as_dict() for row in planned.rows]).encode("utf-8"))
        result["out"] = str(out)
    if not as_json:
        _show(planned, result)
        if out is not None:
            echo(f"Poses: {out}{note}")
    return result


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


def _station(text: str | None) -> Floats | None:
    import numpy as np

    if text is None:
        return None
    try:
        place = np.array([float(part) for part in text.split(",")])
    except ValueError:
        place = np.empty(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise click.BadParameter(
            f"{text!r} is not a position; give X,Y,Z in mm, e.g. 0,-6000,1600", param_hint="--station"
        )
    return place


def _show(planned: PosePlan, result: Mapping[str, Any]) -> None:
    units = {joint.column: joint for joint in planned.rig.joints}
    first = planned.rows[0]
    header = ["pose", *(units[c].name for c in first.joints), *(c.replace("_dir", " from") for c in first.conditions)]
    rows = []
    for row in planned.rows:
        values = [f"{v:.{1 if units[c].kind == 'revolute' else 0}f}" for c, v in row.joints.items()]
        conditions = [_condition(name, value) for name, value in row.conditions.items()]
        rows.append([str(row.pose), *values, *conditions, _LIST_SEPARATOR.join(row.prisms)])
    title = f"Poses for {planned.rig.name}, deg and mm"
    echo_table([*header, "prisms"], rows, title=title, text_columns=(len(header),))
    minutes, seconds = divmod(round(planned.plan.seconds_of_motion), 60)
    echo(
        f"{result['fixes']} fixes; {minutes} min {seconds} s of motion with every joint at its full rate; "
        f"{result['determined']} of {result['parameters']} parameters determined by these poses"
    )
    spread = planned.after.spread
    echo(
        f"Expected error of the model over the work volume afterwards, mm: mean {number(spread.mean_mm)}, "
        f"median {number(spread.median_mm)}, 95 % within {number(spread.p95_mm)}, 99 % within "
        f"{number(spread.p99_mm)}; {planned.after.where}"
    )
    for effect, sigma in result["stands_out_sigma"].items():
        echo(f"{effect} of plausible size stands out from the others by {sigma:.1f} sigma")
    for title, sentences in (
        ("Further advice", result["advice"]),
        ("Please note", result["warnings"]),
        ("Assumed", result["assumptions"]),
    ):
        echo_list(title, sentences)


def _condition(name: str, value: float) -> str:
    if name.endswith("_dir"):
        return "below" if value == 1 else "above"
    return f"{value:g}"
