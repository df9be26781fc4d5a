"""`rigcal inverse`: the joint values to command so that the true prism is where it should be."""

from __future__ import annotations

from pathlib import Path

import click

from calibration.rig.columns import CLOSURE
from daemon.cli import offline
from daemon.cli.command import REFUSED, Command, Delivered, json_option
from daemon.warm_up import prepare


@click.command(cls=Command)
@offline.model_option
@offline.data_option
@offline.csv_out_option
@json_option
def inverse(directory: Path, data: Path, out: Path | None, *, as_json: bool) -> dict[str, object] | Delivered:
    """Compute the joint values to command, so that the true prisms are where x_mm, y_mm, z_mm of the data say.

    These are places in the frame of the set-up's station as it would measure them, the inverse of `rigcal predict`:
    where the model knows that the station's scale or a prism's constant is wrong, a fix there reads the target.

    The joints in the data are the nominal command: of all joint values that reach the targets, those nearest to it are
    found, inside the limits of the joints. Rows of one pose are solved together: two prisms of a feed give its
    attitude. The whole model counts, effects and learned residual too; columns that these need (direction of approach,
    payload, temperature) are taken from the rows.

    The result is the data's own columns with the joints replaced, and closure_mm: how far the model then has each prism
    from its target. With --json it goes to the file of --out, or else into the object as "csv".

    A target that cannot be reached to 0.01 mm is named; the joints given for it bring the prism as near as can be, and
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
    offline.deliver(table, result, found.warnings, out, as_json=as_json)
    return Delivered(result, REFUSED) if unreached else result
