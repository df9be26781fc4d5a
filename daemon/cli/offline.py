"""`calibrate`, `evaluate`, `predict`: files in, files out, with the functions that the daemon's jobs run."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import click

from calibration.errors import DataError
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig import Rig
from calibration.single_thread import one_blas_thread
from daemon.checkpoint import FileCheckpoint
from daemon.cli.csv_output import check_out, deliver, with_columns
from daemon.cli.options import DIRECTORY, data_option, model_option, prior_option, rig_option, seed_option
from daemon.cli.output import Command, json_option, progress_display
from daemon.cli.tables import say, show_evaluation
from daemon.cli.terminal import Terminal
from daemon.numba_cache import prepare
from daemon.rigs import load_rig
from drivers.clock import NS_PER_S, SystemClock
from drivers.files import read_whole

if TYPE_CHECKING:
    from calibration.identification.refinement import Prior
    from calibration.prediction import Prediction
    from calibration.residual.conformal import Intervals
    from calibration.residual.hybrid import Kind

METHODS = ("default", "pde-paper", "km", "skcm", "rbf-tcm")
RESIDUALS = ("default", "none", "rbfn", "lightgbm", "chain", "gp")
CONNECT_TIMEOUT_S = 5
_DATA_MAX_BYTES = 128 << 20  # half a million fixes
PREDICTED_COLUMNS = tuple(f"{name}_pred_mm" for name in ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z"))
INTERVAL_COLUMNS = tuple(f"{name}_pred_mm" for name in ("half90_x", "half90_y", "half90_z", "radius90"))


def read_observations(path: Path, rig: Rig, *, positions_required: bool = True) -> tuple[Observations, bytes]:
    """An observations CSV and its bytes; DataError if it cannot be read or does not fit the rig."""
    try:
        data = read_whole(path, _DATA_MAX_BYTES)
    except OSError as error:
        raise DataError(str(path), f"cannot be read: {error.strerror}") from error
    return parse_observations(data, rig, path.name, positions_required=positions_required), data


class Stopwatch:
    """How long a command takes, and when."""

    def __init__(self) -> None:
        self._clock = SystemClock()
        self._started_ns = self._clock.monotonic_ns()

    @property
    def seconds(self) -> float:
        return round((self._clock.monotonic_ns() - self._started_ns) / NS_PER_S, 3)

    @property
    def utc_ns(self) -> int:
        return self._clock.now().utc_ns


@click.command(cls=Command)
@rig_option
@data_option
@click.option("--out", type=DIRECTORY, required=True, metavar="DIR", help="Where to write; replaces a model there.")
@click.option("--method", type=click.Choice(METHODS), default="default", show_default=True, help="How to identify.")
@click.option(
    "--effects",
    default="auto",
    show_default=True,
    metavar="auto|none|FAMILY@WHERE,...",
    help="Named physics to add to the kinematics: `auto` what the data ask for, found as `rigcal gap` does; `rigcal "
    "effects` lists the families and where they may be.",
)
@click.option(
    "--residual",
    type=click.Choice(RESIDUALS),
    default="default",
    show_default=True,
    help="Learner of what is left; `default` takes the one that helps on data it has not seen, or none.",
)
@prior_option
@seed_option
@click.option(
    "--time-limit",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="End the global search after this time, and go on with the best until then.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Address of a dask scheduler whose workers share the work (needs the `dask` extra); the result is the same.",
)
@json_option
def calibrate(
    rig: str,
    data: Path,
    out: Path,
    method: str,
    effects: str,
    residual: Kind,
    prior: Prior,
    seed: int,
    time_limit: float | None,
    dask: str | None,
    *,
    as_json: bool,
) -> dict[str, object]:
    """Calibrate a rig from observations; write the model and its report to a directory.

    The figures are about the rows it was fitted to; `evaluate` gives those for rows it never saw. A global search keeps
    its state beside DIR (DIR.checkpoint): the same command, killed and given again, goes on where it was.
    """
    watch = Stopwatch()
    prepare()
    from calibration import pipeline
    from daemon import modelfiles
    from daemon.report import build_report
    from daemon.report.from_model import report_input

    source = load_rig(rig)
    _check_effects(effects, method, source.rig)
    modelfiles.check_target(out)
    observations, raw = read_observations(data, source.rig)
    with (
        FileCheckpoint(out.resolve().with_name(f"{out.resolve().name}.checkpoint")) as checkpoint,
        progress_display(as_json=as_json) as progress,
        _cluster(dask) as executor,
    ):
        model, training = pipeline.calibrate(
            source.rig,
            source.text,
            observations,
            seed=seed,
            prior=prior,
            method=method,
            effects=effects,
            residual=residual,
            executor=executor,
            progress=progress,
            should_stop=None if time_limit is None else lambda: watch.seconds > time_limit,
            checkpoint=checkpoint,
        )
        sources = {"data": f"{data.name}, SHA-256 {hashlib.sha256(raw).hexdigest()}"}
        with ThreadPoolExecutor(1) as pool:  # another process loads the model while this one draws
            loaded = pool.submit(modelfiles.check_loads, model, out)
            document = build_report(report_input(training, None, made_utc_ns=watch.utc_ns, sources=sources))
            loaded.result()
        modelfiles.write_model(out, model, {modelfiles.REPORT: document.encode("utf-8")})
    result = training.as_dict(watch.seconds)
    if not as_json:
        console = Terminal()
        show_evaluation(console, result, f"the {len(training)} fixes it was fitted to")
        say(console, f"Model: {out}   report: {out / modelfiles.REPORT}   {result['seconds']} s")
    return result


@click.command(cls=Command)
@model_option
@data_option
@click.option(
    "--refit-base",
    is_flag=True,
    help="Fit where the base stands in the station's frame, and nothing else, on these rows first.",
)
@json_option
def evaluate(directory: Path, data: Path, *, refit_base: bool, as_json: bool) -> dict[str, object]:
    """Errors of a model, stage by stage, on observations that it was not fitted to."""
    watch = Stopwatch()
    prepare()
    from calibration import pipeline
    from daemon.modelfiles import read_model

    model = read_model(directory)
    observations, _ = read_observations(data, model.rig)
    evaluation = pipeline.evaluate(model, observations, refit_base=refit_base)
    result = evaluation.as_dict(watch.seconds)
    if not as_json:
        show_evaluation(Terminal(), result, f"the {len(evaluation)} fixes of {data.name}")
    return result


@click.command(cls=Command)
@model_option
@data_option
@click.option("--out", type=DIRECTORY, metavar="CSV", help="Where to write; standard output by default.")
@click.option(
    "--intervals",
    is_flag=True,
    help="Add half90_x_pred_mm, half90_y_pred_mm, half90_z_pred_mm (a fix is that near to x, y, z with 90 % "
    "probability, each) and radius90_pred_mm (all three together).",
)
@json_option
def predict(directory: Path, data: Path, out: Path | None, *, intervals: bool, as_json: bool) -> dict[str, object]:
    """Positions and their standard deviations for joint readings; positions in the data are not needed.

    The result is the data's own columns and the predicted ones. With --json it goes to the file of --out, or else into
    the object as "csv".
    """
    watch = Stopwatch()
    prepare()
    from daemon.modelfiles import read_model

    check_out(out, data)
    model = read_model(directory)
    observations, raw = read_observations(data, model.rig, positions_required=False)
    with one_blas_thread(), ThreadPoolExecutor() as pool:
        prediction = model.predict(observations, pool)
    columns = _predicted_columns(prediction, model.intervals if intervals else None)
    table = with_columns(raw, columns, {*PREDICTED_COLUMNS, *INTERVAL_COLUMNS} - set(columns))
    doubts = model.doubts(observations)
    result: dict[str, object] = {
        "rig": model.rig.name,
        "n": len(observations),
        "seconds": watch.seconds,
        "warnings": list(doubts),
        "ignored_columns": list(observations.ignored_columns),
    }
    deliver(table, result, doubts, out, as_json=as_json)
    return result


def _predicted_columns(prediction: Prediction, intervals: Intervals | None) -> dict[str, Floats]:
    """What predictions add to an observations CSV, and their intervals where they are wanted."""
    columns = {name: prediction.position_mm[:, i] for i, name in enumerate(PREDICTED_COLUMNS[:3])}
    columns |= {name: prediction.sigma_mm[:, i] for i, name in enumerate(PREDICTED_COLUMNS[3:])}
    if intervals is not None:
        half_mm = intervals.half_mm(prediction.sigma_mm)
        columns |= {name: half_mm[:, i] for i, name in enumerate(INTERVAL_COLUMNS[:3])}
        columns[INTERVAL_COLUMNS[3]] = intervals.radius_mm(prediction.sigma_mm)
    return columns


def _check_effects(effects: str, method: str, rig: Rig) -> None:
    """Refuse effects that are misspelt, that the rig has no place for, or that the method does not take."""
    if effects in ("auto", "none"):
        return
    from calibration.effects.library import parse_effects

    try:
        parse_effects(effects, rig)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--effects") from error
    if method != "default":
        raise click.BadParameter(f"--method {method} takes none", param_hint="--effects")


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Executor | None]:
    """The executor of a dask cluster; None without an address, for threads on this machine."""
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


COMMANDS = {"calibrate": calibrate, "evaluate": evaluate, "predict": predict}
