"""Searches that tests compare, one default and one of the paper, and a store that keeps every state."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from calibration.identification.search.islands import Evolved, Settings, evolve
from calibration.observations import Floats
from calibration.published.paper_evolution import PaperSettings, evolve_paper
from calibration.run_settings import Checkpoint, Run

LOWER, UPPER = np.full(6, -5.0), np.full(6, 5.0)
SMALL = Settings(islands=3, population=40, evaluations=3000, epochs=5)
PAPER = PaperSettings(population=50, generations=24, subpopulations=3)


class Kept:
    """A checkpoint in memory."""

    def __init__(self, state: bytes | None = None) -> None:
        self.states = [] if state is None else [state]

    def load(self) -> bytes | None:
        return self.states[-1] if self.states else None

    def save(self, state: bytes) -> None:
        self.states.append(state)


class File:
    """A checkpoint in a file; `saved` is told how often it was written."""

    def __init__(self, path: Path, saved: Callable[[int], None] = lambda _: None) -> None:
        self.path, self.saved, self.count = path, saved, 0

    def load(self) -> bytes | None:
        return self.path.read_bytes() if self.path.exists() else None

    def save(self, state: bytes) -> None:
        new = self.path.with_suffix(".new")
        new.write_bytes(state)
        new.replace(self.path)
        self.count += 1
        self.saved(self.count)


def rastrigin(population: Floats) -> Floats:
    value: Floats = (population**2 - 10.0 * np.cos(2.0 * np.pi * population) + 10.0).sum(axis=1)
    return value


def sphere(population: Floats) -> Floats:
    value: Floats = ((population - 1.0) ** 2).sum(axis=1)
    return value


def sphere_with_holes(population: Floats) -> Floats:
    return np.where(population[:, 0] < 0.0, np.nan, sphere(population))


def default_search(executor: Executor, checkpoint: Checkpoint | None = None) -> Evolved:
    return evolve(rastrigin, LOWER, UPPER, run=Run(5, executor, checkpoint=checkpoint), settings=SMALL)


def paper_search(executor: Executor, checkpoint: Checkpoint | None = None) -> Evolved:
    return evolve_paper(
        [sphere, rastrigin], rastrigin, LOWER, UPPER, run=Run(5, executor, checkpoint=checkpoint), settings=PAPER
    )


SEARCHES = {"default": default_search, "paper": paper_search}


def search_until_killed(name: str, path: str, saves: int) -> None:
    """Run a search in this process and kill it, with no chance to clean up, after so many saves."""

    def saved(count: int) -> None:
        if count == saves:
            os.kill(os.getpid(), signal.SIGKILL)

    with ThreadPoolExecutor(2) as pool:
        SEARCHES[name](pool, File(Path(path), saved))


def assert_same(found: Evolved, reference: Evolved) -> None:
    """Bit by bit."""
    np.testing.assert_array_equal(found.x, reference.x)
    assert (found.cost, found.evaluations, found.complete) == (
        reference.cost,
        reference.evaluations,
        reference.complete,
    )
