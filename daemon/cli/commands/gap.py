"""`rigcal gap`: names the effects that the simulation lacks, and writes a model with them."""

from __future__ import annotations

from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli import offline
from daemon.cli.command import Command, json_option, progress_display
from daemon.cli.terminal import echo, echo_list, echo_table
from daemon.report.words import number
from daemon.warm_up import prepare

if TYPE_CHECKING:
    from calibration.gap.result import GapResult
    from calibration.identification.refinement import Prior


@click.command(cls=Command)
@offline.rig_option
@offline.data_option
@click.option(
    "--holdout", type=offline.FILE, metavar="CSV", help="Held-out observations to judge the result; none by default."
)
@click.option(
    "--out",
    type=offline.DIRECTORY,
    required=True,
    metavar="DIR",
    help="Directory for model/, report.html and gap.json, and for plan.csv and plan.json if poses are proposed; "
    "an earlier answer there is replaced.",
)
@offline.signal_option
@offline.prior_option
@offline.seed_option
@offline.tolerance_option
@json_option
def gap(
    rig: str,
    data: Path,
    holdout: Path | None,
    out: Path,
    signals: tuple[str, ...],
    prior: Prior,
    seed: int,
    tolerance_mm: float | None,
    *,
    as_json: bool,
) -> dict[str, object]:
    """Find the effects that the simulation lacks.

    Finds where simulation and measurement disagree, names the missing effects, and adds them to the model. The verdict
    is `named` (the effects are part of the written model), `none` (nothing beyond the noise), `indistinguishable` (up
    to three effects that these data cannot distinguish, with poses that can) or `unidentified` (structure that no
    effect of the library explains, with the variables that it depends on). The exit status is 0 for each of them.
    `rigcal effects` lists the library.
    """
    watch = offline.Stopwatch()
    prepare()
    from calibration.experiments.comparison import shared_rows
    from calibration.pipeline.find_gap import find_gap
    from calibration.run_settings import Run
    from daemon.models.gap_files import REPORT, check_gap_target, gap_answer, write_gap
    from daemon.report.calibration.from_model import facts_of, provenance
    from daemon.report.gap.page import gap_report
    from daemon.report.gap.words import tolerance_verdict
    from daemon.rig_files import load_rig

    source = load_rig(rig, signals)
    check_gap_target(out)
    observations, raw = offline.read_observations(data, source.rig)
    offline.require_columns(observations, signals, data)
    files = {"data": offline.source_line(data, raw)}
    held_out = None
    overlap: tuple[str, ...] = ()
    if holdout is not None:
        held_out, held_out_raw = offline.read_observations(holdout, source.rig)
        _, overlap = shared_rows(observations, held_out, (data.name, holdout.name))
        files["held-out data"] = offline.source_line(holdout, held_out_raw)
    with progress_display(as_json=as_json) as progress:
        run = Run(seed, progress=progress)
        found = find_gap(source.rig, source.text, observations, holdout=held_out, prior=prior, run=run)
        progress(1.0, "drawing the report and writing the model")
        found = replace(found, warnings=(*overlap, *found.warnings))
        facts = facts_of(observations, found.model, name=out.name, made_utc_ns=watch.utc_ns, tolerance_mm=tolerance_mm)
        document = gap_report(found, provenance(found.model, watch.utc_ns, files), facts)
        verdict = tolerance_verdict(found, tolerance_mm)
        result = gap_answer(found, watch.seconds) | ({} if verdict is None else {"tolerance": verdict.as_dict()})
        note = offline.replaced(out)
        write_gap(out, found, result, document)
    if not as_json:
        show_gap(found)
        if verdict is not None:
            offline.show_verdict(verdict)
        echo(f"Model: {out / 'model'}{note}   report: {out / REPORT}   {result['seconds']} s")
    return result


def show_gap(found: GapResult) -> None:
    """Print the workflow's answer for people."""
    from daemon.report.gap.words import before_and_after, dependence, gap_headline, remaining
    from daemon.report.words import place_name

    echo(gap_headline(found), bold=True)
    if found.description:
        echo(dependence(found))
    before, after, where, _ = before_and_after(found)
    change = (
        f"{number(before)} mm before, {number(after)} mm with the effects" if found.effects else f"{number(before)} mm"
    )
    echo(f"Error {where}: {change}; noise floor {number(found.noise_mm)} mm ({found.noise_source})")
    if found.effects:
        _show_effects(found)
    echo_list(
        "One of these, which these data cannot distinguish",
        [f"{place_name(c.family, c.where)}: {c.posterior:.0%}" for c in found.indistinguishable],
    )
    echo_list(
        "Where simulation and measurement disagree",
        [f"{d.where}, by {d.variable} (p = {d.p:.1g})" for d in found.disagreements],
    )
    if found.remaining_significant:
        echo(f"{remaining(found)} that was not named.")
    echo_list("What to measure next", [experiment.text for experiment in found.experiments])
    echo_list("Not searched for", [f"{name.replace('_', ' ')}: {reason}" for name, reason in found.disabled.items()])
    echo_list("Please note", found.warnings)
    if found.observations.ignored_columns:
        echo(f"Ignored columns: {', '.join(found.observations.ignored_columns)}")


def _show_effects(found: GapResult) -> None:
    from daemon.report.words import INTERVAL_SIGMAS

    rows = []
    for effect in found.effects:
        heads = [(effect.family, effect.where), *([(f"  {effect.form}", "")] if effect.form else [])]
        values = [
            (c.name, f"{c.value:.4g}", f"\N{PLUS-MINUS SIGN} {INTERVAL_SIGMAS * c.standard_error:.2g}", c.unit)
            for c in effect.reported
        ]
        for head, value in zip_longest(heads, values, fillvalue=()):
            rows.append([*(head or ("", "")), *(value or ("",) * 4)])
    header = ("effect", "where", "coefficient", "value", "95 % interval", "unit")
    echo_table(header, rows, title="Effects added to the model", text_columns=(0, 1, 2, 5))
