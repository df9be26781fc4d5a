"""`rigcal calibrate`: fits a model to observations and writes it with its report."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli import offline
from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.terminal import echo
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from calibration.identification.refinement import Prior
    from calibration.residual.selection import Kind
    from calibration.rig.description import Rig

METHODS = ("default", "pde-paper", "km", "skcm", "rbf-tcm")
RESIDUALS = ("default", "none", "rbfn", "lightgbm", "chain", "gp")
CONNECT_TIMEOUT_S = 5


@click.command(cls=Command)
@offline.rig_option
@offline.data_option
@click.option(
    "--out",
    type=offline.DIRECTORY,
    required=True,
    metavar="DIR",
    help="Directory of the new model; an existing model there is replaced.",
)
@click.option(
    "--method", type=click.Choice(METHODS), default="default", show_default=True, help="Method of identification."
)
@click.option(
    "--effects",
    default="auto",
    show_default=True,
    metavar="auto|none|FAMILY@WHERE,...",
    help="Effects to add to the kinematics: `auto` for those that the data show, found as by `rigcal gap`; `rigcal "
    "effects` lists the families and their places.",
)
@click.option(
    "--residual",
    type=click.Choice(RESIDUALS),
    default="default",
    show_default=True,
    help="Learner of the residual error; `default` selects the one that is best on unseen data, or none.",
)
@offline.signal_option
@offline.prior_option
@offline.seed_option
@offline.time_limit_option
@offline.tolerance_option
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Address of a dask scheduler whose workers do the work (requires the `dask` extra); the result is the same.",
)
@json_option
def calibrate(
    rig: str,
    data: Path,
    out: Path,
    method: str,
    effects: str,
    residual: Kind,
    signals: tuple[str, ...],
    prior: Prior,
    seed: int,
    time_limit: float | None,
    tolerance_mm: float | None,
    dask: str | None,
    *,
    as_json: bool,
) -> dict[str, object]:
    """Calibrate a rig and write its model and report.

    The reported errors are for the rows that the model was fitted to; `rigcal evaluate` reports errors for other rows.
    A global search stores its state in the file DIR.checkpoint: after an interruption, the same command resumes it.
    """
    watch = offline.Stopwatch()
    prepare()
    from calibration.pipeline.calibrate import calibrate as calibrate_rig
    from calibration.run_settings import Run
    from daemon.jobs.checkpoint import FileCheckpoint
    from daemon.models import model_files
    from daemon.report.calibration.from_model import facts_of, report_input
    from daemon.report.calibration.page import calibration_report
    from daemon.rig_files import load_rig

    source = load_rig(rig, signals)
    _check_effects(effects, method, source.rig)
    model_files.check_target(out)
    observations, raw = offline.read_observations(data, source.rig)
    offline.require_columns(observations, signals, data)
    with (
        FileCheckpoint(out.resolve().with_name(f"{out.resolve().name}.checkpoint")) as checkpoint,
        progress_display(as_json=as_json) as progress,
        _cluster(dask) as executor,
    ):
        model, training = calibrate_rig(
            source.rig,
            source.text,
            observations,
            prior=prior,
            method=method,
            effects=effects,
            residual=residual,
            run=Run(
                seed,
                executor,
                progress,
                should_stop=lambda: time_limit is not None and watch.seconds > time_limit,
                checkpoint=checkpoint,
            ),
        )
        progress(1.0, "drawing the report and checking that the model loads")
        with ThreadPoolExecutor(1) as pool:  # a child process loads the model in the meantime
            loaded = pool.submit(model_files.check_loads, model, out)
            sources = {"data": offline.source_line(data, raw)}
            facts = facts_of(observations, model, name=out.name, made_utc_ns=watch.utc_ns, tolerance_mm=tolerance_mm)
            document = calibration_report(
                report_input(training, None, made_utc_ns=watch.utc_ns, sources=sources, facts=facts)
            )
            loaded.result()
        note = offline.replaced(out)
        model_files.write_model(out, model, {model_files.REPORT: document.encode("utf-8")})
    result = training.as_dict(watch.seconds)
    if not as_json:
        offline.show_evaluation(result, f"the {len(training)} fixes it was fitted to")
        echo(f"Model: {out}{note}   report: {out / model_files.REPORT}   {result['seconds']} s")
    rows = f"on the {len(training)} fixes it was fitted to"
    rms_mm = float(training.stages()[-1]["rms_mm"])
    return offline.judged(result, tolerance_mm, rms_mm, rows, is_held_out=False, as_json=as_json)


def _check_effects(effects: str, method: str, rig: Rig) -> None:
    """Refuse effects that are misspelt, that have no place on the rig, or that the method does not support."""
    if effects in ("auto", "none"):
        return
    from calibration.effects.library import parse_effects

    try:
        parse_effects(effects, rig)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--effects") from error
    if method != "default":
        raise click.BadParameter(f"--method {method} does not support effects", param_hint="--effects")


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Executor | None]:
    """Yield the executor of a dask cluster; None without an address, for threads on this computer."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise click.BadParameter(
            "the `dask` extra is not installed: pip install 'rigcal[dask]'", param_hint="--dask"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise click.BadParameter(f"no dask scheduler at {address}: {error}", param_hint="--dask") from error
    with client:
        yield client.get_executor()
