"""`rigcal gap`: what the simulation lacks, by name, and the model that has it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from daemon.cli.offline import Stopwatch, read_observations
from daemon.cli.options import DIRECTORY, FILE, data_option, prior_option, rig_option, seed_option
from daemon.cli.output import Command, json_option, progress_display
from daemon.cli.tables import say
from daemon.cli.terminal import Terminal
from daemon.numba_cache import prepare
from daemon.report.markup import number
from daemon.rigs import load_rig

if TYPE_CHECKING:
    from calibration.gap.result import Gap
    from calibration.identification.refinement import Prior

_SHOWN = 8
_INTERVAL = 2.0  # standard errors of a 95 % interval


@click.command(cls=Command)
@rig_option
@data_option
@click.option("--holdout", type=FILE, metavar="CSV", help="Observations that nothing is fitted to, to judge by.")
@click.option(
    "--out",
    type=DIRECTORY,
    required=True,
    metavar="DIR",
    help="Where model/, report.html and gap.json go, and plan.csv and plan.json where poses are asked for; "
    "replaces an earlier answer.",
)
@prior_option
@seed_option
@json_option
def gap(
    rig: str,
    data: Path,
    holdout: Path | None,
    out: Path,
    prior: Prior,
    seed: int,
    *,
    as_json: bool,
) -> dict[str, object]:
    """Find where simulation and measurement disagree, name the missing physics, and add it.

    The verdict is `named` (the effects are part of the model that is written), `none` (nothing beyond the noise),
    `indistinguishable` (at most three effects that this data cannot tell apart, with poses that will) or `unidentified`
    (structure that no effect of the library explains, with what it depends on). All four end with exit status 0.
    `rigcal effects` lists the library.
    """
    watch = Stopwatch()
    prepare()
    from calibration.comparison import shared_rows
    from calibration.gap.workflow import find_gap
    from daemon.gap_files import REPORT, check_gap_target, gap_answer, write_gap
    from daemon.report.from_model import provenance
    from daemon.report.gap import gap_report

    source = load_rig(rig)
    check_gap_target(out)
    observations, raw = read_observations(data, source.rig)
    files = {"data": f"{data.name}, SHA-256 {hashlib.sha256(raw).hexdigest()}"}
    held_out = None
    overlap: tuple[str, ...] = ()
    if holdout is not None:
        held_out, held_out_raw = read_observations(holdout, source.rig)
        overlap = shared_rows(observations, held_out, (data.name, holdout.name))
        files["held-out data"] = f"{holdout.name}, SHA-256 {hashlib.sha256(held_out_raw).hexdigest()}"
    with progress_display(as_json=as_json) as progress:
        found = find_gap(
            source.rig, source.text, observations, holdout=held_out, prior=prior, seed=seed, progress=progress
        )
    found = replace(found, warnings=(*overlap, *found.warnings))
    document = gap_report(found, provenance(found.model, watch.utc_ns, files))
    result = gap_answer(found, watch.seconds)
    write_gap(out, found, result, document)
    if not as_json:
        console = Terminal()
        show_gap(console, found)
        say(console, f"Model: {out / 'model'}   report: {out / REPORT}   {result['seconds']} s")
    return result


def show_gap(console: Console, found: Gap) -> None:
    """Print what the workflow found, for people."""
    from daemon.report.gap_words import before_and_after, dependence, gap_headline, place_name, remaining

    console.print(gap_headline(found), style="bold", highlight=False, markup=False)
    if found.description:
        say(console, dependence(found))
    before, after, where = before_and_after(found)
    change = (
        f"{number(before)} mm before, {number(after)} mm with the effects" if found.effects else f"{number(before)} mm"
    )
    say(console, f"Error {where}: {change}; noise floor {number(found.noise_mm)} mm ({found.noise_source})")
    if found.effects:
        console.print(_effect_table(found))
    if found.indistinguishable:
        lines = [f"{place_name(c.family, c.where)}: {c.posterior:.0%}" for c in found.indistinguishable]
        _sentences(console, "One of these, which this data cannot tell apart", lines)
    chance = [f"{d.where}, by {d.variable} (p = {d.p:.1g})" for d in found.disagreements]
    _sentences(console, "Where simulation and measurement disagree", chance)
    if found.remaining_significant:
        say(console, f"{remaining(found)} that was not named.")
    _sentences(console, "What to measure next", [experiment.text for experiment in found.experiments])
    needs = [f"{family.replace('_', ' ')}: {reason}" for family, reason in found.disabled.items()]
    _sentences(console, "Not looked for", needs)
    _sentences(console, "Please note", found.warnings)
    if found.observations.ignored_columns:
        say(console, f"Ignored columns: {', '.join(found.observations.ignored_columns)}")


def _effect_table(found: Gap) -> Table:
    table = Table(title="Effects added to the model", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for name in ("effect", "where", "coefficient", "value", "95 % interval", "unit"):
        table.add_column(name, justify="right" if name in ("value", "95 % interval") else "left", no_wrap=True)
    for effect in found.effects:
        heads = [(effect.family, effect.where), *([(f"  {effect.form}", "")] if effect.form else [])]
        rows = []
        for c in effect.reported:
            half = _INTERVAL * c.standard_error
            rows.append((c.name, f"{c.value:.4g}", f"\N{PLUS-MINUS SIGN} {half:.2g}", c.unit))
        for head, row in zip_longest(heads, rows, fillvalue=()):
            table.add_row(*(head or ("", "")), *(row or ("",) * 4))
    return table


def _sentences(console: Console, title: str, sentences: Sequence[str]) -> None:
    if not sentences:
        return
    console.print(f"{title}:", style="bold", highlight=False, markup=False)
    for sentence in sentences[:_SHOWN]:
        say(console, f"  - {sentence}")
    if len(sentences) > _SHOWN:
        say(console, f"  and {len(sentences) - _SHOWN} more (--json has all)")


COMMANDS = {"gap": gap}
