"""`rigcal bench`: how well the program does on data of which the truth is known, and hidden from it."""

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
    from daemon.benchmark.run import Run
    from daemon.benchmark.score import Score, Tally

_WORDS = ("right", "part", "wrong", "set", "unidentified", "none", "failed")
_SHOWN = 40


@click.group()
def bench() -> None:
    """Benchmarks on simulated rigs."""


@bench.command(cls=Command, name="gap")
@click.option("--rig", default="swdt82", show_default=True, metavar="RIG", help="Shipped name, or path of a rig file.")
@click.option("--short", is_flag=True, help="A few cases of every kind, for a first look: a minute or two.")
@click.option(
    "--cells",
    metavar="KIND,...",
    help="Only these kinds of case: single, null, decoy, pair, triple, outside, left_out, alias, beside, machine, "
    "regime, path.",
)
@click.option("--poses", metavar="KIND,...", help="Only these poses: wide, face, sparse, many, path.")
@click.option("--noises", metavar="KIND,...", help="Only these encoders: fine, stepped (0.02 deg), coarse (0.1 deg).")
@click.option("--effects", metavar="FAMILY,...", help="Only these families among the single effects.")
@click.option("--sizes", metavar="SIZE,...", help="Only these visible sizes, in units of the noise.")
@click.option("--repeats", type=click.IntRange(min=1), metavar="N", help="Cases of every cell; 1 by default.")
@click.option(
    "--first",
    type=click.IntRange(min=0),
    metavar="SEED",
    help="Seed of the first case, 1000000 by default. Below that are the seeds to tune on, from there on those to "
    "report.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=lambda: os.cpu_count() or 1,
    metavar="N",
    help="Processes that analyse; as many as there are cores by default.",
)
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Keep observations, labels and answers there; thrown away by default.",
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
    """Hide known effects in simulated observations and see which the gap workflow names.

    The hidden effects are in a file that the analysis is not given; the same seed draws the same cases. Shares are
    given with Wilson's 95 % intervals. The exit status is 1 where a bar is missed by more than chance.
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


def as_dict(found: Run) -> dict[str, object]:
    """JSON object of `rigcal bench gap`."""
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


def _show(found: Run) -> None:
    _show_scores(found.scores)
    if found.tallies:
        _show_families(found.tallies)
    echo_list("Cells that could not reach their size within the library's bounds", _counted(found.dropped), _SHOWN)
    missed = [t for t in found.trials if t.is_wrong or t.verdict == "failed"]
    echo_list(
        "Named wrong, or ended in an error",
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
    header = ("family", "size", *_WORDS, "taken for")
    echo_table(header, rows, title="Single effects", text_columns=(0, len(header) - 1))


def _counted(counts: Mapping[str, int]) -> list[str]:
    return [f"{name} ({number})" for name, number in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]
