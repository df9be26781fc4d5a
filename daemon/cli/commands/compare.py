"""`rigcal compare`: all methods on the same rows, or the experiments of Zhou et al. 2022."""

from __future__ import annotations

import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli import offline
from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.terminal import echo, echo_list, echo_table
from daemon.host.safe_output import write_file
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.experiments.comparison import Comparison
    from calibration.experiments.zhou2022.protocol import Protocol
    from calibration.identification.refinement import Prior

PROTOCOLS = ("zhou2022",)
_MOST = 1000  # sentences: all of them


@click.command(cls=Command)
@offline.rig_option
@click.option("--data", type=offline.FILE, required=True, metavar="CSV", help="Observations to fit.")
@click.option(
    "--holdout", type=offline.FILE, required=True, metavar="CSV", help="Held-out observations to judge the methods."
)
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    help="Instead of all methods, run the experiments of Zhou et al. 2022, section 4.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(),
    metavar="DIR",
    help="Directory for the page with plots, comparison-RIG.html; the current directory by default.",
)
@offline.signal_option
@offline.prior_option
@click.option(
    "--refit-base",
    is_flag=True,
    help="First fit the position of the base in the station's frame, and nothing else, to the held-out rows.",
)
@offline.seed_option
@offline.time_limit_option
@offline.tolerance_option
@json_option
def compare(
    rig: str,
    data: Path,
    holdout: Path,
    protocol: str | None,
    out: Path,
    signals: tuple[str, ...],
    prior: Prior,
    seed: int,
    time_limit: float | None,
    tolerance_mm: float | None,
    *,
    refit_base: bool,
    as_json: bool,
) -> dict[str, object]:
    """Compare all methods on held-out observations.

    The result is a table, and a page with plots. Rows are named as in `calibrate --method` and `--residual`. Each
    residual has a row, based on the default method's kinematics and effects; `table` is a table of corrections per cell
    of boom reach and direction, `rbfn-paper` a published network.

    A method that cannot use the data is listed with the reason. With --protocol zhou2022 the rig is instead calibrated
    from single-joint, multi-joint and weighted data. The result then has the Pareto front of the weights, a learning
    curve and the error along the first 200 held-out points of the tip, with the figures of the paper for comparison.
    """
    if protocol is not None and refit_base:
        raise click.UsageError(f"--protocol {protocol} uses the set-ups of --data; omit --refit-base")
    prepare()
    from calibration.experiments.comparison import compare as compare_methods
    from calibration.experiments.comparison import shared_rows
    from calibration.experiments.zhou2022.protocol import run_protocol
    from calibration.run_settings import Run
    from daemon.report.comparison import comparison_page
    from daemon.report.front import Facts
    from daemon.report.zhou2022 import protocol_page
    from daemon.rig_files import load_rig

    watch = offline.Stopwatch()
    source = load_rig(rig, signals)
    training, raw = offline.read_observations(data, source.rig)
    offline.require_columns(training, signals, data)
    held_out, held_out_raw = offline.read_observations(holdout, source.rig)
    page = out / f"comparison-{re.sub(r'[^A-Za-z0-9._-]+', '-', source.rig.name)}.html"
    out.mkdir(parents=True, exist_ok=True)
    shared, overlap = shared_rows(training, held_out, (data.name, holdout.name))
    sources = {
        "training rows": offline.source_line(data, raw),
        "held-out rows": offline.source_line(holdout, held_out_raw),
        "prior and seed": f"{prior}, {seed}",
    }
    facts = Facts(
        source.rig.name,
        sessions=[str(name) for name in sorted({*training.session, *held_out.session})],
        setups=[str(name) for name in sorted({*training.setup, *held_out.setup})],
        model="none: methods side by side",
        made_utc_ns=watch.utc_ns,
        tolerance_mm=tolerance_mm,
    )
    given = source.rig, source.text, training, held_out
    with progress_display(as_json=as_json) as progress:
        if protocol is None:
            comparison = compare_methods(
                *given,
                clock=lambda: watch.seconds,
                prior=prior,
                refit_base=refit_base,
                time_limit_s=time_limit,
                run=Run(seed, progress=progress),
            )
            comparison = replace(comparison, warnings=(*overlap, *comparison.warnings))
            result, document = comparison.as_dict(), comparison_page(comparison, sources, facts)
        else:
            with ThreadPoolExecutor(max_workers=os.cpu_count()) as executor:
                experiments = run_protocol(
                    *given,
                    clock=lambda: watch.seconds,
                    prior=prior,
                    time_limit_s=time_limit,
                    run=Run(seed, executor, progress),
                )
            experiments = replace(experiments, warnings=(*overlap, *experiments.warnings))
            result, document = experiments.as_dict(), protocol_page(experiments, sources, facts)
    write_file(page, document.encode("utf-8"))
    if not as_json:
        if protocol is None:
            show_comparison(comparison)
        else:
            show_protocol(experiments)
        echo(f"Page with plots: {page}")
    result |= {"page": str(page)}
    own = next((r for r in comparison.results if r.method == "default"), None) if protocol is None else None
    if own is None or own.error_mm is None:
        return result
    rms_mm = float((own.error_mm**2).mean() ** 0.5)
    rows = f"on {len(held_out)} held-out fixes by rigcal" + (f", {shared} of which it was fitted to" if shared else "")
    return offline.judged(result, tolerance_mm, rms_mm, rows, is_held_out=not shared, as_json=as_json)


def show_comparison(comparison: Comparison) -> None:
    """Print the table of all methods and residuals, and its notes."""
    from daemon.report.comparison import HEADER, LOWEST, TEXT_COLUMNS, label, refusals, table_rows

    own = [result.method == "default" for result in comparison.results]
    title = f"Position error in mm on {comparison.held_out} held-out fixes ({LOWEST} the lowest)"
    echo_table(HEADER, table_rows(comparison), title=title, text_columns=TEXT_COLUMNS, bold=own)
    echo_list("Not applicable", refusals(comparison), _MOST)
    notes = [f"{label(r.method)}: {note}" for r in comparison.results for note in r.notes]
    echo_list("Please note", [*comparison.warnings, *notes], _MOST)


def show_protocol(protocol: Protocol) -> None:
    """Print all tables of the experiments, with the paper's figures."""
    from daemon.report import zhou2022

    first = (0,)
    echo_table(
        *zhou2022.before_table(protocol),
        title="Before calibration: mean error of the nominal model",
        text_columns=first,
    )
    header, rows = zhou2022.identification_table(protocol)
    echo_table(
        header,
        rows + zhou2022.paper_rows(protocol),
        title="Table 3: mean error in mm on the held-out fixes, per prism",
        text_columns=(0, 1),
    )
    if protocol.front is not None:
        echo(zhou2022.weights_sentence(protocol.front))
    echo_table(
        *zhou2022.learning_table(protocol.learning),
        title="Learning curve: RMS error on the held-out fixes",
        text_columns=first,
    )
    path = protocol.trajectory
    title = f"Trajectory: {len(path.rows)} held-out points of prism {path.prism}"
    echo_table(*zhou2022.trajectory_table(path), title=title, text_columns=first)
    echo_list("Please note", [*protocol.warnings, *zhou2022.not_taken(path)], _MOST)
