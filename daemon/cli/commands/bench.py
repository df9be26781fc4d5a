"""`rigcal bench`: benchmarks on simulated data whose truth is hidden from the analysis."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command import DONE, FAILED, Command, Delivered, json_option, progress_display
from daemon.cli.terminal import Coloured, echo, echo_list, echo_table

if TYPE_CHECKING:
    from daemon.benchmark.run import BenchmarkResult
    from daemon.benchmark.score import Score, Tally

_WORDS = ("right", "part", "wrong", "set", "unidentified", "none", "failed")
_SHOWN = 40


@click.group()
def bench() -> None:
    """Run benchmarks on simulated rigs."""


@bench.command(cls=Command, name="gap")
@click.option(
    "--rig", default="swdt82", show_default=True, metavar="RIG", help="Name of a shipped rig, or path of a rig file."
)
@click.option("--short", is_flag=True, help="Run only a few cases of every kind; takes a minute or two.")
@click.option(
    "--cells",
    metavar="KIND,...",
    help="Only these kinds of case: single, null, decoy, pair, triple, outside, left_out, alias, beside, machine, "
    "regime, path.",
)
@click.option("--poses", metavar="KIND,...", help="Only these poses: wide, face, sparse, many, path.")
@click.option("--noises", metavar="KIND,...", help="Only these encoders: fine, stepped (0.02 deg), coarse (0.1 deg).")
@click.option("--effects", metavar="FAMILY,...", help="Only these families of single effects.")
@click.option("--sizes", metavar="SIZE,...", help="Only these visible sizes, in units of the noise.")
@click.option("--repeats", type=click.IntRange(min=1), metavar="N", help="Number of cases per cell; 1 by default.")
@click.option(
    "--first",
    type=click.IntRange(min=0),
    metavar="SEED",
    help="Seed of the first case; 1000000 by default. Smaller seeds are for tuning, these and larger ones for "
    "reporting.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=lambda: os.cpu_count() or 1,
    metavar="N",
    help="Number of worker processes; the number of cores by default.",
)
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Directory in which to keep observations, labels and answers; deleted by default.",
)
@json_option
def gap(
    rig: str,
    cells: str | None,
    poses: str | None,
    noises: str | None,
    effects: str | None,
    sizes: str | None,
    repeats: int | None,
    first: int | None,
    workers: int,
    keep: Path | None,
    *,
    short: bool,
    as_json: bool,
) -> Delivered:
    """Score the gap workflow on simulated hidden effects.

    Known effects are hidden in simulated observations, and the answers of the workflow are compared with them. The
    hidden effects are in a file that the analysis does not get; the same seed draws the same cases. Shares have 95 %
    Wilson intervals. The exit status is 1 if a target is missed by more than chance.
    """
    from daemon.benchmark.cases import NoSuchCasesError
    from daemon.benchmark.run import run

    options = ["--short"] if short else []
    chosen = {"cells": cells, "poses": poses, "noises": noises, "effects": effects, "sizes": sizes}
    for name, value in {**chosen, "repeats": repeats, "first": first}.items():
        options += [] if value is None else [f"--{name}", str(value)]
    with ExitStack() as stack:
        if keep is None:
            directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rigcal-bench-")))
        else:
            keep.mkdir(parents=True, exist_ok=True)
            directory = keep
        progress = stack.enter_context(progress_display(as_json=as_json))
        try:
            found = run(rig, options, directory, workers=workers, progress=progress)
        except NoSuchCasesError as error:
            raise click.UsageError(str(error)) from error
    if not as_json:
        _show(found)
    is_good = all(score.met is not False or score.is_chance for score in found.scores)
    return Delivered(as_dict(found), DONE if is_good else FAILED)


def as_dict(found: BenchmarkResult) -> dict[str, object]:
    """Return the JSON object of `rigcal bench gap`."""
    return {
        "rig": found.rig,
        "cases": len(found.trials),
        "labels_sha256": found.labels_sha256,
        "answers_sha256": found.answers_sha256,
        "rules": list(found.rules),
        "scores": [asdict(score) for score in found.scores],
        "families": [_tally(tally) for tally in found.tallies],
        "dropped": dict(found.dropped),
        "trials": [
            {
                "case": t.case,
                "kind": t.kind,
                "poses": t.poses,
                "noise": t.noise,
                "size": t.size,
                "seed": t.seed,
                "truth": [f"{e.family}@{e.where}" for e in t.effects],
                "separable": t.separable,
                "plain": t.plain,
                "rival": t.alternative,
                "outcome": t.outcome,
                "named": [f"{e['family']}@{e['where']}" for e in t.answer.get("effects", ())],
                "set": sorted(t.reported_set),
                "wrong": sum(t.names_told),
                "regime": None if t.regime is None else asdict(t.regime),
                "regime_told": t.told_regime,
                "resolved": None if t.measured is None else t.is_resolved,
                "description": t.answer.get("description"),
                "gap_closed": t.closed,
                "seconds": t.answer["seconds"],
                "error": t.answer.get("error"),
            }
            for t in found.trials
        ],
    }


def _tally(tally: Tally) -> dict[str, Any]:
    return {
        "family": tally.family,
        "size": tally.size,
        "outcomes": dict(tally.outcomes),
        "mistaken_for": dict(tally.mistaken),
    }


def _show(found: BenchmarkResult) -> None:
    _show_scores(found.scores)
    if found.tallies:
        _show_families(found.tallies)
    echo_list("Cells that could not reach their size within the library's bounds", _counted(found.dropped), _SHOWN)
    missed = [t for t in found.trials if t.is_wrong or t.verdict == "failed"]
    echo_list(
        "Wrongly named, or ended in an error",
        [
            f"{t.kind} {t.poses} {t.noise} {t.size:g}x seed {t.seed}: "
            f"{' + '.join(f'{e.family}@{e.where}' for e in t.effects) or 'nothing'} answered as "
            + (str(t.answer.get("error")) if t.verdict == "failed" else ", ".join(sorted(t.named)))
            for t in missed
        ],
        _SHOWN,
    )
    echo_list("How cases were drawn and judged", found.rules, _SHOWN)
    echo(f"SHA-256 of the answers: {found.answers_sha256}; of the labels: {found.labels_sha256}")


def _show_scores(found: Sequence[Score]) -> None:
    rows = []
    for score in found:
        if not score.n:
            continue
        span = "" if score.interval is None else f"{score.interval[0]:.3f} .. {score.interval[1]:.3f}"
        mark = "missed, perhaps by chance" if score.is_chance else {True: "met", False: "missed", None: ""}[score.met]
        colour = "red" if score.met is False else ""
        cells = (score.what, score.target, f"{score.value:.3f}", span, str(score.n), mark)
        rows.append([Coloured(cell, colour) for cell in cells])
    echo_table(("what", "target", "measured", "95 %", "n", ""), rows, title="Scores", text_columns=(0, 5))


def _show_families(found: Sequence[Tally]) -> None:
    rows = []
    for tally in found:
        counts = [str(tally.outcomes[word] or "") for word in _WORDS]
        rows.append([tally.family, f"{tally.size:g}", *counts, ", ".join(_counted(Counter(tally.mistaken)))])
    header = ("family", "size", *_WORDS, "mistaken for")
    echo_table(header, rows, title="Single effects", text_columns=(0, len(header) - 1))


def _counted(counts: Mapping[str, int]) -> list[str]:
    return [f"{name} ({number})" for name, number in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]
