"""Common parts of the offline commands: options, reading observations, writing results."""

from __future__ import annotations

import csv
import io
import logging
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.terminal import echo, echo_error, echo_list, echo_table
from daemon.host.safe_output import shown_lines, write_file
from drivers.clock import NS_PER_S, SystemClock

if TYPE_CHECKING:
    from calibration.observations import Floats, Observations
    from calibration.rig.description import Rig
    from daemon.report.front import Verdict

DATA_MAX_BYTES = 128 << 20  # half a million fixes
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
DIRECTORY = click.Path(path_type=Path)


class _Finite:
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)  # type: ignore[misc]  # of the other base class
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)  # type: ignore[attr-defined]
        return number


class FiniteNumber(_Finite, click.types.FloatParamType):
    """A number; "nan" and "inf" are refused."""


class FiniteRange(_Finite, click.FloatRange):
    """A range of numbers; refuses "nan", which passes comparisons with the limits."""


ABOVE_0 = FiniteRange(min=0, min_open=True)
rig_option = click.option("--rig", required=True, metavar="RIG", help="Name of a shipped rig, or path of a rig file.")
data_option = click.option("--data", type=FILE, required=True, metavar="CSV", help="Observations, one row per fix.")
signal_option = click.option(
    "--signal",
    "signals",
    multiple=True,
    metavar="COLUMN",
    help="Also use this column of numbers, like a [[signal]] of the rig file: NAME_UNIT, or NAME without a unit "
    "(tilt_x_deg, oil_degC). May be repeated; stored with the model.",
)
model_option = click.option(
    "--model",
    "directory",
    type=DIRECTORY,
    required=True,
    metavar="DIR",
    help="Directory of a model, as written by `rigcal calibrate`.",
)
prior_option = click.option(
    "--prior",
    type=click.Choice(("recalibration", "as-built")),
    default="recalibration",
    show_default=True,
    help="Trust the rig's build tolerances, or estimate from the data how far the machine deviates from the drawings.",
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random choices."
)
csv_out_option = click.option("--out", type=DIRECTORY, metavar="CSV", help="File to write; standard output by default.")
tolerance_option = click.option(
    "--tolerance",
    "tolerance_mm",
    type=ABOVE_0,
    metavar="MM",
    help="Report whether the root mean square error is within this tolerance in mm. Only held-out fixes can pass.",
)
time_limit_option = click.option(
    "--time-limit",
    type=ABOVE_0,
    metavar="SECONDS",
    help="End each global search after this many seconds, and continue with its best result. No limit by default.",
)


class Stopwatch:
    """Measures the duration of a command, from its creation."""

    def __init__(self) -> None:
        self._clock = SystemClock()
        self._started_ns = self._clock.monotonic_ns()

    @property
    def seconds(self) -> float:
        """Seconds since its creation."""
        return round((self._clock.monotonic_ns() - self._started_ns) / NS_PER_S, 3)

    @property
    def utc_ns(self) -> int:
        """The current time."""
        return self._clock.now().utc_ns


# ---- observations in -------------------------------------------------------------------------------------------------


def read_observations(path: Path, rig: Rig, *, positions_required: bool = True) -> tuple[Observations, bytes]:
    """Read an observations CSV; return the table and the file's bytes.

    Args:
        path: of the file.
        rig: the rig that was measured.
        positions_required: whether the file must have positions.

    Raises:
        DataError: the file cannot be read or does not fit the rig.
    """
    from calibration.errors import DataError
    from calibration.observations import parse_observations
    from drivers.files import read_whole

    try:
        data = read_whole(path, DATA_MAX_BYTES)
    except OSError as error:
        raise DataError(str(path), f"cannot be read: {error.strerror}") from error
    return parse_observations(data, rig, path.name, positions_required=positions_required), data


def require_columns(observations: Observations, columns: Sequence[str], path: Path) -> None:
    """Raise DataError if the observations lack one of the optional columns that were requested with --signal."""
    from calibration.errors import DataError

    for column in columns:
        if column not in observations.extra:
            raise DataError(path.name, "the file has no such column, although --signal names it", column=column)


def source_line(path: Path, data: bytes) -> str:
    """Return a file's name and SHA-256, for a report."""
    import hashlib

    return f"{path.name}, SHA-256 {hashlib.sha256(data).hexdigest()}"


# ---- results out -----------------------------------------------------------------------------------------------------


def check_out(out: Path | None, data: Path) -> None:
    """Refuse to overwrite the data with the result."""
    if out is not None and out.exists() and out.samefile(data):
        raise click.UsageError(f"{out} is the input file; name a different file with --out")


def replaced(out: Path) -> str:
    """Return " (replaced)" for a file or a directory with files that is about to be replaced, else ""."""
    return " (replaced)" if out.is_file() or (out.is_dir() and any(out.iterdir())) else ""


def with_columns(raw: bytes, columns: Mapping[str, Floats], dropped: Collection[str] = ()) -> str:
    """Return an observations CSV unchanged except for replaced, added and dropped columns.

    Args:
        raw: the file's bytes, which `parse_observations` has read.
        columns: name -> (n,) numbers; they replace the column of that name or are added after all others.
        dropped: names of columns to omit if they exist.
    """
    reader = csv.reader(io.StringIO(raw.decode("utf-8-sig"), newline=""), strict=True)
    header, *rows = [row for row in reader if row]
    names = [name.strip() for name in header]
    keep = [i for i, name in enumerate(names) if name not in dropped]
    added = [name for name in columns if name not in names]
    cells = {name: [repr(float(value)) for value in values] for name, values in columns.items()}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(names[i] for i in keep), *added])
    for number, row in enumerate(rows):
        own = (cells[names[i]][number] if names[i] in cells else row[i] for i in keep)
        writer.writerow([*own, *(cells[name][number] for name in added)])
    return out.getvalue()


def deliver(
    table: str, what: str, result: dict[str, object], warnings: Sequence[str], out: Path | None, *, as_json: bool
) -> None:
    """Write a table to the file, or put it into the JSON object as "csv", or print it; print the warnings.

    Args:
        table: the CSV.
        what: the rows with their number, in words: "12 positions"; shown with the file's name.
        result: the JSON object, to which the table or the path of its file is added.
        warnings: for people; the JSON object has them already.
        out: the file; None for none.
        as_json: True if standard output is for the JSON object.
    """
    if out is not None:
        note = replaced(out)
        write_file(out, table.encode("utf-8"))
        result["out"] = str(out)
        if not as_json:
            echo(f"{what} written to {out}{note}")
    elif as_json:
        result["csv"] = table
    else:
        click.echo(shown_lines(table) if sys.stdout.isatty() else table, nl=False)
    for warning in () if as_json else warnings:
        echo_error(f"Warning: {warning}", logging.WARNING)


def show_stages(result: Mapping[str, Any], title: str) -> None:
    """Print the errors of each stage, for all rows and for each prism.

    Args:
        result: JSON object of an evaluation.
        title: of the table.
    """
    from daemon.report.words import number

    figures = ("mean", "rms", "max", "std")
    rows = []
    for i, stage in enumerate(result["stages"]):
        cells = [number(stage[f"{name}_mm"]) for name in figures]
        cells += [number(stages[i]["rms_mm"]) for stages in result["per_prism"].values()]
        rows.append([stage["stage"], *cells])
    header = ["stage", *figures, *(f"rms {prism}" for prism in result["per_prism"])]
    echo_table(header, rows, title=title, text_columns=(0,), bold=[row[0] == "hybrid" for row in rows])


def show_evaluation(result: Mapping[str, Any], rows: str) -> None:
    """Print the result of `calibrate` or `evaluate`.

    Args:
        result: the JSON object (docs/reference/formats.md).
        rows: the rows that the errors refer to, e.g. "the 250 fixes it was fitted to".
    """
    from daemon.report.words import number

    show_stages(result, f"Position error in mm on {rows}")
    seen = result["identifiability"]
    effects = ", ".join(f"{e['family']}@{e['where']}" for e in result["effects"])
    echo(
        f"scatter of a fix {number(result['noise_mm'])} mm; effects: {effects or 'none'}; "
        f"learned residual: {result['residual'] or 'none'}; "
        f"{seen['rank']} of {seen['parameters']} parameters determined by the data"
    )
    if result["residual"] is None:
        echo(f"no residual: {result['residual_reason']}")
    covered = result["intervals"]
    axes = ", ".join(f"{share:.0%}" for share in covered["axis_coverage"])
    echo(
        f"{covered['level']:.0%} intervals contain {axes} of the errors in x, y, z and "
        f"{covered['radius_coverage']:.0%} of the 3-D errors"
    )
    expected = result["expected_accuracy"]
    if expected is not None:
        place = f" at set-up {expected['setup']!r}" if expected["setup"] else ""
        echo(
            f"expected error of the model over the work volume{place}: {number(expected['rms_mm'])} mm RMS, 95 % "
            f"within {number(expected['p95_mm'])} mm, {expected['where']}"
        )
    if result["axes"]:
        _show_axes(result["axes"])
    echo_list("Not determined", seen["unidentifiable"])
    echo_list("Please note", result["warnings"])
    if result["ignored_columns"]:
        echo(f"Ignored columns: {', '.join(result['ignored_columns'])}")


def judged(
    result: dict[str, object], tolerance_mm: float | None, rms_mm: float, rows: str, *, is_held_out: bool, as_json: bool
) -> dict[str, object]:
    """Add the verdict on a tolerance to a result, if a tolerance is given; print it for people.

    Args:
        result: the JSON object.
        tolerance_mm: root mean square error that the machine may have; None if none is given.
        rms_mm: root mean square error of the model.
        rows: the fixes that the error refers to, in words.
        is_held_out: whether the model was not fitted to these fixes.
        as_json: True to print nothing.
    """
    from daemon.report.front import judge

    verdict = judge(tolerance_mm, rms_mm, is_held_out=is_held_out, rows=rows)
    if verdict is None:
        return result
    if not as_json:
        show_verdict(verdict)
    return result | {"tolerance": verdict.as_dict()}


def show_verdict(verdict: Verdict) -> None:
    """Print the verdict on a tolerance, in colour."""
    colour = {"passed": "green", "failed": "red", "not judged": "yellow"}[verdict.outcome]
    echo(verdict.sentence, fg=colour, bold=True)


def _show_axes(axes: Sequence[Mapping[str, Any]]) -> None:
    """Print, for each joint, the single-joint sweep that deviates most from the model."""
    from daemon.report.words import number

    def chance(axis: Mapping[str, Any]) -> float:
        return float(min(axis["p_axis"], axis["p_curve"]))

    worst = [
        min((axis for axis in axes if axis["joint"] == joint), key=chance)
        for joint in dict.fromkeys(axis["joint"] for axis in axes)
    ]
    rows = [
        [
            axis["joint"],
            axis["prism"],
            f"{number(axis['angle_deg'])} ± {number(axis['angle_sigma_deg'])}",
            f"{number(axis['offset_mm'])} ± {number(axis['offset_sigma_mm'])}",
            f"{chance(axis):.2g}",
        ]
        for axis in worst
    ]
    echo_table(
        ("joint", "prism", "angle, deg", "offset, mm", "by chance"),
        rows,
        title="Axes of single-joint sweeps, deviation from the model",
        text_columns=(0, 1),
        bold=[bool(axis["sentence"]) for axis in worst],
    )
