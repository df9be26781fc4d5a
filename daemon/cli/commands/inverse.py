"""`rigcal inverse`: joint values to command so that the true prisms reach their targets."""

from __future__ import annotations

from pathlib import Path

import click

from calibration.rig.columns import CLOSURE
from calibration.rig.words import counted
from daemon.cli import offline
from daemon.cli.command import REFUSED, Command, Delivered, json_option
from daemon.warm_up import prepare


@click.command(cls=Command)
@offline.model_option
@offline.data_option
@offline.csv_out_option
@json_option
def inverse(directory: Path, data: Path, out: Path | None, *, as_json: bool) -> dict[str, object] | Delivered:
    """Compute the joint values that bring prisms to targets.

    With these joint values the true prisms reach x_mm, y_mm, z_mm of the data. Targets are in the frame of the set-up's
    station as it would measure them, so this is the inverse of `rigcal predict`: if the model knows that the station's
    scale or a prism constant is wrong, a fix there reads the target.

    The joints in the data are the nominal command: of all joint values within the limits that reach the targets, the
    nearest to it are found. Rows of one pose are solved together, so that two prisms of a feed determine its attitude.
    The whole model is used, including effects and learned residual; the columns that these need (direction of
    approach, payload, temperature) are taken from the rows.

    The result is the data with the joints replaced and a column closure_mm, the distance of each prism from its target
    according to the model. With --json it is written to the file of --out, or else is in the object as "csv".

    A target that cannot be reached within 0.01 mm is reported; its joints then bring the prism as near as possible, and
    the exit status is 3.
    """
    watch = offline.Stopwatch()
    prepare()
    from calibration.model.inverse import inverse as solve
    from calibration.numerics.single_thread import one_blas_thread
    from daemon.models.model_files import read_model

    offline.check_out(out, data)
    model = read_model(directory)
    targets, raw = offline.read_observations(data, model.rig)
    with one_blas_thread():
        found = solve(model, targets)
    commands = {joint.column: found.observations.joints[joint.name] for joint in model.rig.joints}
    table = offline.with_columns(raw, {**commands, CLOSURE.name: found.closure_mm})
    unreached = (~found.reached).nonzero()[0].tolist()
    result: dict[str, object] = {
        "rig": model.rig.name,
        "n": len(targets),
        "seconds": watch.seconds,
        "worst_closure_mm": float(found.closure_mm.max()),
        "unreached_lines": [targets.row_number(row) for row in unreached],
        "warnings": list(found.warnings),
        "ignored_columns": list(targets.ignored_columns),
    }
    what = f"joint values for {counted(len(targets), 'position')}"
    offline.deliver(table, what, result, found.warnings, out, as_json=as_json)
    return Delivered(result, REFUSED) if unreached else result
