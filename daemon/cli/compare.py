"""`rigcal compare`: all methods on the same rows, or the first paper's experiments."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from daemon.cli.offline import read_observations
from daemon.cli.options import FILE, prior_option, rig_option, seed_option
from daemon.cli.output import Command, json_option, progress_display
from daemon.cli.tables import say
from daemon.cli.terminal import Terminal
from daemon.files import write_file
from daemon.numba_cache import prepare
from daemon.rigs import load_rig
from drivers.clock import NS_PER_S, SystemClock

if TYPE_CHECKING:
    from calibration.comparison import Comparison
    from calibration.identification.refinement import Prior
    from calibration.published.zhou2022.protocol import Protocol

PROTOCOLS = ("zhou2022",)
_WIDEST = 1000


@click.command(cls=Command)
@rig_option
@click.option("--data", type=FILE, required=True, metavar="CSV", help="Observations to fit.")
@click.option("--holdout", type=FILE, required=True, metavar="CSV", help="Observations to judge by, never fitted.")
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    help="Instead of all methods: the experiments of Zhou et al. 2022, section 4.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(),
    metavar="DIR",
    help="Where the page with the plots goes, as comparison-RIG.html; the current directory by default.",
)
@prior_option
@click.option(
    "--refit-base",
    is_flag=True,
    help="Fit where the base stands in the station's frame, and nothing else, on the held-out rows first.",
)
@seed_option
@click.option(
    "--time-limit",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="End each global search after this time; the paper's takes a minute or more by itself.",
)
@json_option
def compare(
    rig: str,
    data: Path,
    holdout: Path,
    protocol: str | None,
    out: Path,
    prior: Prior,
    seed: int,
    time_limit: float | None,
    *,
    refit_base: bool,
    as_json: bool,
) -> dict[str, object]:
    """Compare all methods on held-out observations, in a table and on a page with plots.

    Rows have the names of `calibrate --method` and `--residual`. On the default method's kinematics and effects every
    residual has a row of its own; `table` are stored corrections per cell of boom reach and direction, `rbfn-paper` is
    a published network.

    A method that cannot use the data is listed with its reason. With --protocol zhou2022 the rig is calibrated from
    single-joint, multi-joint and weighted data instead, with the Pareto front of the weights, a learning curve and the
    error along the first 200 held-out points of the tip; the paper's own figures stand beside.
    """
    if protocol is not None and refit_base:
        raise click.UsageError(f"--protocol {protocol} judges at the set-ups of --data; leave --refit-base out")
    prepare()
    from calibration.comparison import compare as compare_methods
    from calibration.comparison import shared_rows
    from calibration.published.zhou2022.protocol import run_protocol
    from daemon.report.comparison import comparison_page
    from daemon.report.zhou2022 import protocol_page

    source = load_rig(rig)
    training, raw = read_observations(data, source.rig)
    held_out, held_out_raw = read_observations(holdout, source.rig)
    page = out / f"comparison-{re.sub(r'[^A-Za-z0-9._-]+', '-', source.rig.name)}.html"
    out.mkdir(parents=True, exist_ok=True)
    overlap = shared_rows(training, held_out, (data.name, holdout.name))
    sources = {
        "training rows": f"{data.name}, SHA-256 {hashlib.sha256(raw).hexdigest()}",
        "held-out rows": f"{holdout.name}, SHA-256 {hashlib.sha256(held_out_raw).hexdigest()}",
        "prior and seed": f"{prior}, {seed}",
    }
    given = source.rig, source.text, training, held_out
    console = Terminal()
    with progress_display(as_json=as_json) as progress:
        if protocol is None:
            comparison = compare_methods(
                *given,
                clock=_seconds,
                seed=seed,
                prior=prior,
                refit_base=refit_base,
                time_limit_s=time_limit,
                progress=progress,
            )
            comparison = replace(comparison, warnings=(*overlap, *comparison.warnings))
            result, document = comparison.as_dict(), comparison_page(comparison, sources)
        else:
            with ThreadPoolExecutor(max_workers=os.cpu_count()) as executor:
                experiments = run_protocol(
                    *given,
                    clock=_seconds,
                    executor=executor,
                    seed=seed,
                    prior=prior,
                    time_limit_s=time_limit,
                    progress=progress,
                )
            experiments = replace(experiments, warnings=(*overlap, *experiments.warnings))
            result, document = experiments.as_dict(), protocol_page(experiments, sources)
    write_file(page, document.encode("utf-8"))
    if not as_json:
        if protocol is None:
            show_comparison(console, comparison)
        else:
            show_protocol(console, experiments)
        say(console, f"Page with plots: {page}")
    return {**result, "page": str(page)}


def show_comparison(console: Console, comparison: Comparison) -> None:
    """The table of all methods and residuals, and what is to be said of it."""
    from daemon.report.comparison import HEADER, LOWEST, TEXT_COLUMNS, label, refusals, table_rows

    own = [result.method == "default" for result in comparison.results]
    title = f"Position error in mm on {comparison.held_out} held-out fixes ({LOWEST} the lowest)"
    _table(console, title, HEADER, table_rows(comparison), text_columns=TEXT_COLUMNS, bold=own)
    _sentences(console, "Not applicable", refusals(comparison))
    notes = [f"{label(r.method)}: {note}" for r in comparison.results for note in r.notes]
    _sentences(console, "Please note", [*comparison.warnings, *notes])


def show_protocol(console: Console, protocol: Protocol) -> None:
    """Every table of the experiments, the paper's figures beside."""
    from daemon.report import zhou2022

    _table(console, "Before calibration: mean error of the nominal model", *zhou2022.before_table(protocol))
    header, rows = zhou2022.identification_table(protocol)
    title = "Table 3: mean error in mm on the held-out fixes, per prism"
    _table(console, title, header, rows + zhou2022.paper_rows(protocol), text_columns=(0, 1))
    if protocol.front is not None:
        say(console, zhou2022.weights_sentence(protocol.front))
    learning = zhou2022.learning_table(protocol.learning)
    _table(console, "Learning curve: RMS error on the held-out fixes", *learning)
    path = protocol.trajectory
    title = f"Trajectory: {len(path.rows)} held-out points of prism {path.prism}"
    _table(console, title, *zhou2022.trajectory_table(path))
    _sentences(console, "Please note", [*protocol.warnings, *zhou2022.not_taken(path)])


def _table(
    console: Console,
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    text_columns: Sequence[int] = (0,),
    bold: Sequence[bool] = (),
) -> None:
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, name in enumerate(header):
        table.add_column(name, justify="left" if number in text_columns else "right", no_wrap=True)
    for number, row in enumerate(rows):
        table.add_row(*row, style="bold" if bold and bold[number] else None)
    # A number that is cut short is no number: on a narrow terminal the lines wrap.
    needed = Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum
    Terminal(width=max(needed, console.width)).print(table)


def _sentences(console: Console, title: str, sentences: Sequence[str]) -> None:
    if sentences:
        console.print(f"{title}:", style="bold", highlight=False)
    for sentence in sentences:
        say(console, f"  - {sentence}")


def _seconds() -> float:
    return SystemClock().monotonic_ns() / NS_PER_S


COMMANDS = {"compare": compare}
