"""Differential evolution finds optima, and the same ones wherever it runs."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest

from calibration.identification.evolution import Evolved, Settings, evolve
from calibration.observations import Floats

LOWER, UPPER = np.full(6, -5.0), np.full(6, 5.0)
SMALL = Settings(islands=3, population=40, evaluations=3000, epochs=5)


def rastrigin(population: Floats) -> Floats:
    value: Floats = (population**2 - 10.0 * np.cos(2.0 * np.pi * population) + 10.0).sum(axis=1)
    return value


def sphere_with_holes(population: Floats) -> Floats:
    cost = ((population - 1.0) ** 2).sum(axis=1)
    return np.where(population[:, 0] < 0.0, np.nan, cost)


def run(executor: Executor, seed: int = 5) -> Evolved:
    return evolve(rastrigin, LOWER, UPPER, seed=seed, executor=executor, settings=SMALL)


def test_the_answer_depends_neither_on_the_executor_nor_on_its_workers() -> None:
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(3) as three:
        reference, other = run(one), run(three)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as processes:
        spawned = run(processes)
    for found in (other, spawned):
        np.testing.assert_array_equal(found.x, reference.x)
        assert found.cost == reference.cost
        assert found.evaluations == reference.evaluations


def test_another_seed_is_another_search() -> None:
    with ThreadPoolExecutor(2) as pool:
        assert not np.array_equal(run(pool, 1).x, run(pool, 2).x)


def test_the_search_leaves_the_many_local_optima_of_rastrigin() -> None:
    settings = Settings(islands=4, population=80, evaluations=12_000, epochs=10)
    with ThreadPoolExecutor(2) as pool:
        found = evolve(rastrigin, LOWER, UPPER, seed=0, executor=pool, settings=settings)
    assert found.cost < 1e-6
    assert np.abs(found.x).max() < 1e-3


def test_candidates_without_a_cost_lose() -> None:
    with ThreadPoolExecutor(2) as pool:
        found = evolve(sphere_with_holes, LOWER, UPPER, seed=0, executor=pool, settings=SMALL)
    np.testing.assert_allclose(found.x, 1.0, atol=0.05)


def test_a_given_start_is_never_lost_and_progress_ends_at_one() -> None:
    shares: list[float] = []
    tiny = Settings(islands=2, population=20, evaluations=60, epochs=2)
    with ThreadPoolExecutor(1) as pool:
        found = evolve(
            rastrigin,
            LOWER,
            UPPER,
            seed=0,
            executor=pool,
            settings=tiny,
            start=np.zeros((1, 6)),
            progress=shares.append,
        )
    assert found.cost == 0.0
    assert shares == [0.5, 1.0]


def test_progress_that_raises_ends_the_search() -> None:
    def cancel(share: float) -> None:
        raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        evolve(rastrigin, LOWER, UPPER, seed=0, executor=pool, settings=SMALL, progress=cancel)
