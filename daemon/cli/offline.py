"""`calibrate`, `evaluate`, `predict`: files in, files out, with the functions that the daemon's jobs run."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from rich.console import Console

from calibration.errors import DataError
from calibration.observations import Observations, parse_observations
from calibration.rig import Rig
from daemon.checkpoint import FileCheckpoint
from daemon.cli.options import FILE, prior_option, rig_option, seed_option
from daemon.cli.output import Command, json_option, progress_display
from daemon.cli.tables import say, show_evaluation
from daemon.files import write_file
from daemon.numba_cache import prepare
from daemon.rigs import load_rig
from drivers.clock import NS_PER_S, SystemClock

if TYPE_CHECKING:
    from calibration.identification.refinement import Prior
    from calibration.model import Prediction
    from calibration.residual.hybrid import Kind

METHODS = ("default", "pde-paper", "km", "skcm", "rbf-tcm")
RESIDUALS = ("default", "none", "rbfn", "lightgbm", "chain")
CONNECT_TIMEOUT_S = 5
PREDICTED_COLUMNS = tuple(f"{name}_pred_mm" for name in ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z"))

_DIRECTORY = click.Path(path_type=Path)

_data = click.option("--data", type=FILE, required=True, metavar="CSV", help="Observations, one row per fix.")
_model = click.option(
    "--model", "directory", type=_DIRECTORY, required=True, metavar="DIR", help="The directory calibrate wrote."
)


def read_observations(path: Path, rig: Rig, *, positions_required: bool = True) -> tuple[Observations, bytes]:
    """An observations CSV and its bytes; DataError if it cannot be read or does not fit the rig."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(str(path), f"cannot be read: {error.strerror}") from error
    return parse_observations(data, rig, path.name, positions_required=positions_required), data


class _Stopwatch:
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
@_data
@click.option("--out", type=_DIRECTORY, required=True, metavar="DIR", help="Where to write; replaces a model there.")
@click.option("--method", type=click.Choice(METHODS), default="default", show_default=True, help="How to identify.")
@click.option(
    "--effects",
    default="auto",
    show_default=True,
    metavar="auto|none|FAMILY@WHERE,...",
    help="Named physics to add to the kinematics.",
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
    watch = _Stopwatch()
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
        document = build_report(report_input(training, None, made_utc_ns=watch.utc_ns, sources=sources))
        modelfiles.write_model(out, model, {modelfiles.REPORT: document.encode("utf-8")})
    result = training.as_dict(watch.seconds)
    if not as_json:
        console = Console()
        show_evaluation(console, result, f"the {len(training)} fixes it was fitted to")
        say(console, f"Model: {out}   report: {out / modelfiles.REPORT}   {result['seconds']} s")
    return result


@click.command(cls=Command)
@_model
@_data
@click.option(
    "--refit-base",
    is_flag=True,
    help="Fit where the base stands in the station's frame, and nothing else, on these rows first.",
)
@json_option
def evaluate(directory: Path, data: Path, *, refit_base: bool, as_json: bool) -> dict[str, object]:
    """Errors of a model, stage by stage, on observations that it was not fitted to."""
    watch = _Stopwatch()
    prepare()
    from calibration import pipeline
    from daemon.modelfiles import read_model

    model = read_model(directory)
    observations, _ = read_observations(data, model.rig)
    evaluation = pipeline.evaluate(model, observations, refit_base=refit_base)
    result = evaluation.as_dict(watch.seconds)
    if not as_json:
        show_evaluation(Console(), result, f"the {len(evaluation)} fixes of {data.name}")
    return result


@click.command(cls=Command)
@_model
@_data
@click.option("--out", type=_DIRECTORY, metavar="CSV", help="Where to write; standard output by default.")
@json_option
def predict(directory: Path, data: Path, out: Path | None, *, as_json: bool) -> dict[str, object]:
    """Positions and their standard deviations for joint readings; positions in the data are not needed.

    The result is the data's own columns and the predicted ones. With --json it goes to the file of --out, or else into
    the object as "csv".
    """
    watch = _Stopwatch()
    prepare()
    from daemon.modelfiles import read_model

    if out is not None and out.exists() and out.samefile(data):
        raise click.UsageError(f"{out} is the data itself; name another file with --out")
    model = read_model(directory)
    observations, raw = read_observations(data, model.rig, positions_required=False)
    table = with_predictions(raw, model.predict(observations))
    result: dict[str, object] = {
        "rig": model.rig.name,
        "n": len(observations),
        "seconds": watch.seconds,
        "warnings": list(model.doubts(observations)),
        "ignored_columns": list(observations.ignored_columns),
    }
    if out is not None:
        write_file(out, table.encode("utf-8"))
        result["out"] = str(out)
    elif as_json:
        result["csv"] = table
    else:
        click.echo(table, nl=False)
    for warning in () if as_json else model.doubts(observations):
        click.echo(f"Warning: {warning}", err=True)
    return result


def with_predictions(raw: bytes, prediction: Prediction) -> str:
    """An observations CSV as it came, with the predicted columns added; ones that it has already are replaced."""
    reader = csv.reader(io.StringIO(raw.decode("utf-8-sig"), newline=""), strict=True)
    header, *rows = [row for row in reader if row]
    keep = [i for i, name in enumerate(header) if name.strip() not in PREDICTED_COLUMNS]
    numbers = np.hstack([prediction.position_mm, prediction.sigma_mm])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(header[i].strip() for i in keep), *PREDICTED_COLUMNS])
    for row, predicted in zip(rows, numbers, strict=True):
        writer.writerow([*(row[i] for i in keep), *(repr(float(value)) for value in predicted)])
    return out.getvalue()


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
