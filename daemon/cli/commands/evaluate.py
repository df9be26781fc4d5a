"""`rigcal evaluate`: the errors of a model on observations."""

from __future__ import annotations

from pathlib import Path

import click

from daemon.cli.command import Command, json_option
from daemon.cli.offline import (
    Stopwatch,
    data_option,
    judged,
    model_option,
    read_observations,
    show_evaluation,
    tolerance_option,
)
from daemon.warm_up import prepare


@click.command(cls=Command)
@model_option
@data_option
@click.option(
    "--refit-base",
    is_flag=True,
    help="Fit where the base stands in the station's frame, and nothing else, on these rows first.",
)
@tolerance_option
@json_option
def evaluate(
    directory: Path, data: Path, tolerance_mm: float | None, *, refit_base: bool, as_json: bool
) -> dict[str, object]:
    """Give the errors of a model, stage by stage, on observations that it was not fitted to."""
    watch = Stopwatch()
    prepare()
    from calibration.evaluation.evaluation import evaluate as evaluate_model
    from calibration.observations import data_sha256
    from daemon.models.model_files import read_model

    model = read_model(directory)
    observations, _ = read_observations(data, model.rig)
    evaluation = evaluate_model(model, observations, refit_base=refit_base)
    result = evaluation.as_dict(watch.seconds)
    if not as_json:
        show_evaluation(result, f"the {len(evaluation)} fixes of {data.name}")
    is_held_out = data_sha256(observations, model.rig) != model.provenance.get("data_sha256")
    rms_mm = float(evaluation.stages()[-1]["rms_mm"])
    rows = f"on the {len(evaluation)} fixes of {data.name}"
    return judged(result, tolerance_mm, rms_mm, rows, is_held_out=is_held_out, as_json=as_json)
