"""`python -m simulators.blind.case_files`: draw cases with hidden effects, and measure further poses of them.

    draw     CASE.csv, CASE-held-out.csv (readings without positions) and, if the scoring needs it, CASE-twin.csv (the
             same machine and noise without effects); cases.json, the cases and the families that the analysis may not
             use; labels.json, the hidden effects of each case and everything else that the scoring needs
    measure  CASE-measured.csv: the observations of a case with further poses, for each case named in a file

The same options draw the same files. An analysis gets the first two files of a case, and never the labels.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from calibration.errors import RigError
from calibration.rig.description import Rig
from simulators.blind.cases import RULES, draw, families, measured
from simulators.blind.cells import KINDS, NOISES, POSES, REPORTED_FROM, SIZES, Cell, full_plan, short_plan
from simulators.effects.library import OUTSIDE
from simulators.rig.truth import load_rig

CASES, LABELS = "cases.json", "labels.json"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simulators.blind.case_files", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("do", choices=("draw", "measure"))
    add = parser.add_argument
    add("--rig", required=True, help="a shipped rig's name or a path to a TOML file")
    add("--out", type=Path, required=True, help="directory for observations and labels")
    add("--plan", type=Path, help="measure: a JSON file, case -> rows of a pose plan")
    add("--workers", type=int, default=os.cpu_count() or 1, help="number of worker processes")
    add("--first", type=int, default=REPORTED_FROM, help="seed of the first case")
    add("--short", action="store_true", help="draw only a few cases of every kind")
    add("--cells", default="", help="kinds of case: KIND,...")
    add("--poses", default="", help="kinds of poses: KIND,...")
    add("--noises", default="", help="kinds of noise: KIND,...")
    add("--effects", default="", help="families of single effects: FAMILY,...")
    add("--sizes", default="", help="visible sizes of single effects: SIZE,...")
    add("--repeats", type=int, default=1, help="number of cases per cell")
    return parser


def _cells(rig: Rig, options: argparse.Namespace) -> tuple[Cell, ...]:
    """Return the cells that the options select; ValueError for an unknown name or an empty selection."""
    known = families(rig)
    kinds = _chosen("cells", options.cells, KINDS)
    poses = _chosen("poses", options.poses, POSES)
    noises = _chosen("noises", options.noises, NOISES)
    single = _chosen("effects", options.effects, known)
    sizes = [float(size) for size in _chosen("sizes", options.sizes, [f"{size:g}" for size in SIZES])]
    if options.first < 0 or options.repeats < 1 or options.workers < 1:
        raise ValueError("first must not be negative, repeats and workers at least 1")
    outside, first = tuple(OUTSIDE), options.first
    plan = short_plan(known, outside, first) if options.short else full_plan(known, outside, first, options.repeats)
    if first < REPORTED_FROM <= plan[-1].seed:
        raise ValueError(f"seeds from {first} on reach the reported seeds, which begin at {REPORTED_FROM}")
    chosen = tuple(
        cell
        for cell in plan
        if cell.kind in kinds
        and cell.poses in poses
        and cell.noise in noises
        and (cell.kind != "single" or (cell.families[0] in single and cell.size in sizes))
    )
    if not chosen:
        raise ValueError("the options select no case; remove some of them")
    return chosen


def _chosen(option: str, text: str, known: Sequence[str]) -> Sequence[str]:
    """Return the names that an option lists, or all known names if it lists none."""
    wanted = [part.strip() for part in text.split(",") if part.strip()]
    if unknown := [part for part in wanted if part not in known]:
        raise ValueError(f"--{option} {unknown[0]}: unknown; known: {', '.join(known)}")
    return wanted or known


def _draw(rig: Rig, cells: Sequence[Cell], directory: Path, pool: ProcessPoolExecutor) -> None:
    public: list[dict[str, Any]] = []
    labels: list[dict[str, Any]] = []
    dropped: Counter[str] = Counter()
    for number, (cell, drawn) in enumerate(zip(cells, pool.map(partial(draw, rig), cells, chunksize=4), strict=True)):
        if drawn is None:
            dropped[f"{' '.join(cell.families) or cell.kind} {cell.poses} {cell.noise} {cell.size:g}x"] += 1
            continue
        name = f"case-{number:05d}"
        for suffix, text in (("", drawn.train), ("-held-out", drawn.held_out), ("-twin", drawn.twin)):
            if text is not None:
                (directory / f"{name}{suffix}.csv").write_text(text, encoding="utf-8")
        public.append({"case": name, "without": drawn.without})
        labels.append({"case": name, "families": cell.families, **drawn.label})
    for file, content in ((CASES, public), (LABELS, {"rules": RULES, "dropped": dropped, "labels": labels})):
        (directory / file).write_text(json.dumps(content), encoding="utf-8")


def _measure(rig: Rig, plan: Path, directory: Path, pool: ProcessPoolExecutor) -> None:
    wanted: dict[str, list[dict[str, Any]]] = json.loads(plan.read_text(encoding="utf-8"))
    cells = {
        label["case"]: Cell(
            label["kind"], tuple(label["families"]), label["size"], label["poses"], label["noise"], label["seed"]
        )
        for label in json.loads((directory / LABELS).read_text(encoding="utf-8"))["labels"]
    }
    if unknown := [name for name in wanted if name not in cells]:
        raise ValueError(f"{plan}: there is no case {unknown[0]}")
    texts = pool.map(partial(measured, rig), [cells[name] for name in wanted], wanted.values())
    for name, text in zip(wanted, texts, strict=True):
        (directory / f"{name}-measured.csv").write_text(text, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw or measure cases; return the exit status, 2 if the options or the files are not valid."""
    options = _parser().parse_args(arguments)
    try:
        rig = load_rig(options.rig)
        cells = _cells(rig, options) if options.do == "draw" else ()
        with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn"), _prepare_drawing) as pool:
            if options.do == "draw":
                _draw(rig, cells, options.out, pool)
            else:
                _measure(rig, options.plan, options.out, pool)
    except (RigError, KeyError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _prepare_drawing() -> None:
    """Use one core in this process, and exit when the parent process ends."""
    threadpool_limits(1)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), name="parent", daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
