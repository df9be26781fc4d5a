"""A run of the benchmark: sealed cases, answers by worker processes, unsealing, scores."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from daemon.files import write_file
from daemon.gap_bench.analyse import Task, answer, oracle, proposed_poses
from daemon.gap_bench.keeper import Case, Keeper
from daemon.gap_bench.score import Score, Tally, scores, tallies
from daemon.gap_bench.trial import Trial, trial

ANSWERS = "answers.json"
PROPOSED = 20  # poses that a set may ask for
# Shares of a run's time, for its progress.
_DRAWN, _ANSWERED = 0.05, 0.9

Progress = Callable[[float, str], None]
Told = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Run:
    """What a run found.

    Attributes:
        rig: shipped name or path.
        commitment: SHA-256 of the labels, given before the analysis.
        answers_sha256: of the answers, given before the unsealing.
        rules: how cases were drawn and judged, sentences.
        dropped: cells that could not reach their size within the library's bounds -> number of cases.
        trials: every case.
    """

    rig: str
    commitment: str
    answers_sha256: str
    rules: tuple[str, ...]
    dropped: Mapping[str, int]
    trials: tuple[Trial, ...]

    @property
    def scores(self) -> tuple[Score, ...]:
        """Every bar."""
        return scores(self.trials)

    @property
    def tallies(self) -> tuple[Tally, ...]:
        """Family by family."""
        return tallies(self.trials)


def run(
    rig: str,
    options: Sequence[str],
    directory: Path,
    *,
    workers: int,
    commit: Callable[[str, int], None],
    progress: Progress,
) -> Run:
    """Draw, analyse, unseal, score.

    Args:
        rig: shipped name or path.
        options: which cases, as `python -m simulators.keeper` takes them.
        directory: for observations, sealed labels and answers.
        workers: processes that analyse.
        commit: told the SHA-256 of the sealed labels and the number of cases, before anything is analysed.
        progress: told (share done, what is going on).

    Raises:
        KeeperError: the keeper refused, or its labels are not those it had committed itself to.
    """
    progress(0.0, "drawing cases")
    with (
        Keeper(["--rig", rig, *options], directory) as keeper,
        # Spawned: a worker holds nothing of this process, and this process nothing of the keeper's.
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_the_run) as pool,
    ):
        commit(keeper.commitment, len(keeper.cases))
        told = _answers(pool, [_task(rig, case, case.train) for case in keeper.cases], progress)
        again = [
            _task(rig, case, keeper.measure(case.name, poses))
            for case in keeper.cases
            if told[case.name]["verdict"] == "indistinguishable"
            and (poses := proposed_poses(told[case.name], PROPOSED))
        ]
        measured = {found["case"]: found for found in pool.map(answer, again)}
        answers = json.dumps({"answers": told, "measured": measured}).encode()
        write_file(directory / ANSWERS, answers)
        unsealed = keeper.unseal(directory / ANSWERS)
        progress(_ANSWERED, "calibrating twins without effects")
        twins = keeper.twins()
        fitted = pool.map(oracle, [_task(rig, c, twins[c.name]) for c in keeper.cases if c.name in twins])
        oracles = {found["case"]: found for found in fitted}
    return Run(
        rig=rig,
        commitment=keeper.commitment,
        answers_sha256=hashlib.sha256(answers).hexdigest(),
        rules=tuple(unsealed["rules"]),
        dropped=unsealed["dropped"],
        trials=tuple(
            trial(label, told[label["case"]], measured.get(label["case"]), oracles.get(label["case"]))
            for label in unsealed["labels"]
        ),
    )


def _end_with_the_run() -> None:
    """In a worker: do not outlive the process that started it, however that ends."""
    run = multiprocessing.parent_process()
    assert run is not None
    threading.Thread(target=_follow, args=(run,), name="run", daemon=True).start()


def _follow(run: BaseProcess) -> None:
    run.join()
    os._exit(1)


def _task(rig: str, case: Case, train: Path) -> Task:
    return Task(case.name, rig, train.read_bytes(), case.held_out.read_bytes(), case.without)


def _answers(pool: Executor, tasks: Sequence[Task], progress: Progress) -> Told:
    """Case -> answer, in the order in which they come."""
    waiting = [pool.submit(answer, task) for task in tasks]
    told: Told = {}
    for future in as_completed(waiting):
        found = future.result()
        told[found["case"]] = found
        share = _DRAWN + (_ANSWERED - _DRAWN) * len(told) / len(tasks)
        progress(share, f"{len(told)} of {len(tasks)} cases analysed")
    return told
