"""The first paper's differential evolution at its full setting: `python -m tests.bench.evolution`.

30,000 candidates of 38 parameters, 200 poses x 4 prisms, F = 0.5, Cr = 1. Prints how long everything takes over its
fitness alone, and a generation of scipy's differential evolution over one of ours: scipy with the same compiled
objective on the same threads, and scipy with an objective in NumPy. Fitness alone is timed between the generations, on
the same threads and parts, so that whatever else the machine does falls on both.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.optimize import Bounds, differential_evolution
from threadpoolctl import threadpool_limits

from calibration.published.paper_evolution import PaperSettings, evolve_paper
from calibration.run_settings import Run
from tests.bench.boom import Boom, boom

Floats = NDArray[np.float64]
WORKERS = 2
TURN = 3  # generations
NUMPY_CANDIDATES = 100
NUMPY_GENERATIONS = 2


class _Parts:
    """The objective over the parts of a population, side by side."""

    def __init__(self, problem: Boom, executor: Executor, parts: int) -> None:
        self.problem, self.executor, self.parts = problem, executor, parts

    def __call__(self, population: Floats) -> Floats:
        parts = np.array_split(population, self.parts)
        return np.concatenate(list(self.executor.map(self.problem.fitness, parts)))


class _Clock:
    """Durations of generations; `between` is timed too, and not counted as a part of them."""

    def __init__(self, between: Callable[[], object]) -> None:
        self.generations: list[float] = []
        self.between: list[float] = []
        self._between = between
        self._since = time.perf_counter()

    def __call__(self, *_: object, **__: object) -> None:
        now = time.perf_counter()
        self.generations.append(now - self._since)
        self._between()
        self._since = time.perf_counter()
        self.between.append(self._since - now)


def search(
    problem: Boom, settings: PaperSettings, executor: Executor, between: Callable[[], object]
) -> tuple[_Clock, float]:
    """The paper's search: its generations, the first with the start of the population, and its end's RMS in mm."""
    clock = _Clock(between)
    found = evolve_paper(
        [problem.fitness],
        problem.fitness,
        -problem.width,
        problem.width,
        run=Run(0, executor, progress=clock),
        settings=settings,
    )
    return clock, problem.rms_mm(found.cost)


def scipys(problem: Boom, objective: Callable[[Floats], Floats], population: int, generations: int) -> _Clock:
    """Run scipy's search with the paper's strategy and settings on an objective of (candidates, 38)."""
    width = problem.width
    start = np.random.default_rng(0).uniform(-1.0, 1.0, (population, len(width))) * width
    clock = _Clock(lambda: None)

    def transposed(x: Floats) -> Any:  # with `vectorized` scipy wants a row of them, which its types do not know
        return objective(np.ascontiguousarray(x.T))

    differential_evolution(
        transposed,
        Bounds(-width, width),
        strategy="rand1bin",
        mutation=0.5,
        recombination=1.0,
        init=start,
        maxiter=generations,
        tol=0.0,
        polish=False,
        rng=0,
        vectorized=True,
        updating="deferred",
        callback=clock,
    )
    return clock


def in_numpy(problem: Boom) -> Callable[[Floats], Floats]:
    """The objective candidate by candidate, vectorised over poses and prisms."""
    samples, chain = problem.samples, problem.chain
    x = np.zeros(len(chain))

    def one(candidate: Floats) -> float:
        x[problem.free] = candidate
        return float(((chain.positions_mm(x, samples.data) - samples.position_mm) ** 2).sum())

    return lambda population: np.array([one(candidate) for candidate in population])


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--generations", type=int, default=400)
    parser.add_argument("--turns", type=int, default=2, help="of ours and scipy's, to compare generations")
    options = parser.parse_args()
    settings = PaperSettings(generations=options.generations)
    n = settings.population
    print(f"numpy {np.__version__}, numba {numba.__version__}, scipy {scipy.__version__}; {WORKERS} threads")
    print(f"{n} candidates x {options.generations} generations (the paper's are {PaperSettings().generations})")
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(WORKERS) as executor:
        problem = boom(0)
        # Compiled, or loaded, before any clock runs.
        search(problem, PaperSettings(population=100, generations=2), executor, lambda: None)
        some = np.random.default_rng(0).uniform(-1.0, 1.0, (n, len(problem.width))) * problem.width
        fitness = _Parts(problem, executor, settings.subpopulations)
        clock, rms_mm = search(problem, settings, executor, lambda: fitness(some))
        print(f"it ends at {rms_mm:.1f} mm RMS; the optimum is {problem.rms_mm(problem.optimum):.2f} mm")
        # The start of the population is evaluated as well, which the first duration holds.
        whole, alone = sum(clock.generations), sum(clock.between) * (1.0 + 1.0 / settings.generations)
        print(f"whole {whole:.2f} s, as many evaluations alone {alone:.2f} s: ratio {whole / alone:.3f} (bar 1.15)")
        # Ours and scipy's take turns, as the machine is never quite the same; the fastest generation of each counts.
        few, mine, theirs = replace(settings, generations=TURN), [], []
        for _ in range(options.turns):
            mine += search(problem, few, executor, lambda: None)[0].generations[1:]
            theirs += scipys(problem, fitness, n, TURN).generations[1:]
        generation = min(mine)
        print(
            f"a generation, compiled objective: ours {generation * 1e3:.1f} ms, scipy {min(theirs) * 1e3:.1f} ms: "
            f"ratio {min(theirs) / generation:.2f} (bar 1.5)"
        )
        slow = scipys(problem, in_numpy(problem), NUMPY_CANDIDATES, NUMPY_GENERATIONS)
        per_candidate = min(slow.generations[1:]) / NUMPY_CANDIDATES
        print(
            f"a candidate, scipy with a NumPy objective: {per_candidate * 1e6:.0f} us, from {NUMPY_GENERATIONS} "
            f"generations of {NUMPY_CANDIDATES}; ours {generation / n * 1e6:.2f} us: "
            f"ratio {per_candidate / (generation / n):.0f} (bar 100)"
        )


if __name__ == "__main__":
    main()
