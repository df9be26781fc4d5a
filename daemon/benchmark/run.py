"""A run of the benchmark: draws cases, analyses them in worker processes that see no label, and scores the answers."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from calibration.run_settings import Progress
from daemon.benchmark.analyse import Task, answer, oracle, proposed_poses
from daemon.benchmark.cases import LABELS, Case, draw_cases, measure, read_labels
from daemon.benchmark.score import Score, Tally, scores, tallies
from daemon.benchmark.trial import Trial, trial
from daemon.host.safe_output import write_file

ANSWERS = "answers.json"
PROPOSED = 20  # how many of the poses proposed for a set are measured
MEASURED = ("single", "alias")  # kinds of case for which proposed poses are measured
# Shares of a run's time, for the progress.
_DRAWN, _ANSWERED = 0.05, 0.9


@dataclass(frozen=True)
class BenchmarkResult:
    """Result of a run.

    Attributes:
        rig: name of a shipped rig, or path of a rig file.
        labels_sha256, answers_sha256: checksums of the files, for comparing two runs.
        rules: rules of drawing and judging cases, as sentences.
        dropped: cell that cannot reach its size within the library's bounds -> number of dropped cases.
        trials: all cases.
        scores: all figures of merit.
        tallies: outcomes for each family and size.
    """

    rig: str
    labels_sha256: str
    answers_sha256: str
    rules: tuple[str, ...]
    dropped: Mapping[str, int]
    trials: tuple[Trial, ...]
    scores: tuple[Score, ...]
    tallies: tuple[Tally, ...]


def run(rig: str, options: Sequence[str], directory: Path, *, workers: int, progress: Progress) -> BenchmarkResult:
    """Draw cases, analyse and score them.

    Args:
        rig: name of a shipped rig, or path of a rig file.
        options: the selection of cases, as options of `python -m simulators.blind.case_files draw`.
        directory: for observations, labels and answers.
        workers: number of worker processes.
        progress: called with the share of the work that is done and the current step.

    Raises:
        CasesError: the cases could not be drawn or measured.
    """
    progress(0.0, "drawing cases")
    cases = draw_cases(rig, options, directory)
    # Workers are spawned, so that they share no memory with this process.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent) as pool:
        told = _answers(pool, [_task(rig, case) for case in cases], progress)
        labels = read_labels(directory)
        poses = {
            label["case"]: rows
            for label in labels["labels"]
            if label["kind"] in MEASURED
            and told[label["case"]]["verdict"] == "indistinguishable"
            and (rows := proposed_poses(told[label["case"]], PROPOSED))
        }
        if poses:
            measure(rig, poses, directory)
        again = pool.map(answer, [_task(rig, case, "-measured") for case in cases if case.name in poses])
        measured = {found["case"]: found for found in again}
        answers = json.dumps({"answers": told, "measured": measured}).encode()
        write_file(directory / ANSWERS, answers)
        progress(_ANSWERED, "calibrating twins without effects")
        with_twin = {label["case"] for label in labels["labels"] if label["twin_mm"] is not None}
        fitted = pool.map(oracle, [_task(rig, case, "-twin") for case in cases if case.name in with_twin])
        oracles = {found["case"]: found for found in fitted}
    trials = tuple(
        trial(label, told[label["case"]], measured.get(label["case"]), oracles.get(label["case"]))
        for label in labels["labels"]
    )
    return BenchmarkResult(
        rig=rig,
        labels_sha256=hashlib.sha256((directory / LABELS).read_bytes()).hexdigest(),
        answers_sha256=hashlib.sha256(answers).hexdigest(),
        rules=tuple(labels["rules"]),
        dropped=labels["dropped"],
        trials=trials,
        scores=scores(trials),
        tallies=tallies(trials),
    )


def _end_with_parent() -> None:
    """End this worker when the process that started it ends for any reason."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_follow, args=(parent,), name="parent", daemon=True).start()


def _follow(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _task(rig: str, case: Case, observations: str = "") -> Task:
    return Task(case.name, rig, case.csv(observations), case.csv("-held-out"), case.without)


def _answers(pool: Executor, tasks: Sequence[Task], progress: Progress) -> dict[str, dict[str, Any]]:
    """Analyse all tasks; return case -> answer, in the order of completion."""
    waiting = [pool.submit(answer, task) for task in tasks]
    told: dict[str, dict[str, Any]] = {}
    for future in as_completed(waiting):
        found = future.result()
        told[found["case"]] = found
        share = _DRAWN + (_ANSWERED - _DRAWN) * len(told) / len(tasks)
        progress(share, f"{len(told)} of {len(tasks)} cases analysed")
    return told
