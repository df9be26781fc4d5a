"""`rigcal predict`: predicts positions from joint readings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import click

from calibration.rig.columns import INTERVALS, PREDICTED, names
from calibration.rig.words import counted
from daemon.cli import offline
from daemon.cli.command import Command, json_option
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.model.prediction import Prediction
    from calibration.observations import Floats

PREDICTED_COLUMNS = names(PREDICTED)
INTERVAL_COLUMNS = names(INTERVALS)


@click.command(cls=Command)
@offline.model_option
@offline.data_option
@offline.csv_out_option
@click.option(
    "--intervals",
    is_flag=True,
    help="Add half90_x_pred_mm, half90_y_pred_mm, half90_z_pred_mm (half widths of 90 % intervals of a fix in x, y, z) "
    "and radius90_pred_mm (radius that contains a fix with 90 % probability).",
)
@json_option
def predict(directory: Path, data: Path, out: Path | None, *, intervals: bool, as_json: bool) -> dict[str, object]:
    """Predict positions from joint readings.

    Standard deviations are predicted, too. The data need no positions. The result is the data with the predicted
    columns added. With --json it is written to the file of --out, or else is in the object as "csv".
    """
    watch = offline.Stopwatch()
    prepare()
    from calibration.model.prediction import Predictor
    from calibration.model.warnings import model_warnings
    from calibration.numerics.single_thread import one_blas_thread
    from daemon.models.model_files import read_model

    offline.check_out(out, data)
    model = read_model(directory)
    observations, raw = offline.read_observations(data, model.rig, positions_required=False)
    with one_blas_thread(), ThreadPoolExecutor() as pool:
        prediction = Predictor.of(model).predict(observations, pool)
    columns = _predicted_columns(prediction, intervals=intervals)
    table = offline.with_columns(raw, columns, {*PREDICTED_COLUMNS, *INTERVAL_COLUMNS} - set(columns))
    warnings = model_warnings(model, observations)
    result: dict[str, object] = {
        "rig": model.rig.name,
        "n": len(observations),
        "seconds": watch.seconds,
        "warnings": list(warnings),
        "ignored_columns": list(observations.ignored_columns),
    }
    offline.deliver(table, counted(len(observations), "position"), result, warnings, out, as_json=as_json)
    return result


def _predicted_columns(prediction: Prediction, *, intervals: bool) -> dict[str, Floats]:
    """Return the columns that predictions add to an observations CSV, with intervals if requested."""
    columns = {name: prediction.position_mm[:, i] for i, name in enumerate(PREDICTED_COLUMNS[:3])}
    columns |= {name: prediction.sigma_mm[:, i] for i, name in enumerate(PREDICTED_COLUMNS[3:])}
    if intervals:
        columns |= dict(zip(INTERVAL_COLUMNS, prediction.half_mm.T, strict=False))
        columns[INTERVAL_COLUMNS[3]] = prediction.radius_mm
    return columns
