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

_FIXES_OF_A_BASE = 8  # per set-up; with fewer, a refitted base of six parameters absorbs most of their errors


@click.command(cls=Command)
@model_option
@data_option
@click.option(
    "--refit-base",
    is_flag=True,
    help="First fit the position of the base in the station's frame, and nothing else, to these rows.",
)
@tolerance_option
@json_option
def evaluate(
    directory: Path, data: Path, tolerance_mm: float | None, *, refit_base: bool, as_json: bool
) -> dict[str, object]:
    """Report the errors of a model on other observations.

    The errors are given for each stage of the model, on observations that it was not fitted to.
    """
    watch = Stopwatch()
    prepare()
    from calibration.evaluation.evaluation import evaluate as evaluate_model
    from daemon.models.model_files import read_model

    model = read_model(directory)
    observations, _ = read_observations(data, model.rig)
    evaluation = evaluate_model(model, observations, refit_base=refit_base)
    result = evaluation.as_dict(watch.seconds)
    rows = f"on the {len(evaluation)} fixes of {data.name}"
    if evaluation.fitted:
        rows += f", {evaluation.fitted} of which it was fitted to"
    if not as_json:
        show_evaluation(result, rows.removeprefix("on "))
    rms_mm = float(evaluation.stages()[-1]["rms_mm"])
    is_base_free = refit_base and len(evaluation) < _FIXES_OF_A_BASE * len(evaluation.model.placements)
    is_held_out = not (evaluation.fitted or is_base_free)
    if is_base_free:
        rows += ", too few as the base was fitted to them"
    return judged(result, tolerance_mm, rms_mm, rows, is_held_out=is_held_out, as_json=as_json)
