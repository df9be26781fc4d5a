"""Differential evolution on islands: success-history adaptation with linear population reduction (L-SHADE).

Tanabe and Fukunaga, "Improving the search performance of SHADE using linear population size reduction" (CEC 2014).
Each island has its own random stream and evolves for an epoch wherever the executor puts it; between epochs its best
candidate visits the next island. Islands and their order are fixed by the seed, so the result depends neither on the
executor nor on the number of its workers.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from calibration.observations import Floats

_MEMORY = 6  # H of the paper
_BEST_SHARE = 0.11  # p
_ARCHIVE = 1.4  # archive size over population size


@dataclass(frozen=True)
class Settings:
    """How much to search.

    Attributes:
        islands: independent populations.
        population: candidates of each island at the start.
        least_population: and at the end.
        evaluations: of each island.
        epochs: pieces the evaluations are cut into; migration happens between them.
    """

    islands: int = 4
    population: int = 80
    least_population: int = 8
    evaluations: int = 12_000
    epochs: int = 10


@dataclass(frozen=True)
class Evolved:
    """Result of `evolve`: the best candidate (p,), its cost and the number of evaluations."""

    x: Floats
    cost: float
    evaluations: int


@dataclass(frozen=True)
class _Island:
    population: Floats
    cost: Floats
    archive: Floats
    memory_f: Floats
    memory_cr: Floats
    slot: int
    evaluations: int
    generator: np.random.Generator


def evolve(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    *,
    seed: int,
    executor: Executor,
    settings: Settings,
    start: Floats | None = None,
    progress: Callable[[float], None] | None = None,
) -> Evolved:
    """Minimise `fitness` in a box.

    Args:
        fitness: (candidates, p) -> (candidates,); sent to the executor, so picklable where that is a process pool.
        lower, upper: (p,) bounds.
        seed: of all random streams.
        executor: runs the islands.
        settings: how much to search.
        start: (k, p) candidates that every island begins with.
        progress: told the share that is done.
    """
    streams = np.random.SeedSequence(seed).spawn(settings.islands)
    begin = partial(_begin, fitness, lower, upper, settings, start)
    islands = list(executor.map(begin, streams))
    for epoch in range(settings.epochs):
        target = settings.evaluations * (epoch + 1) // settings.epochs
        islands = list(executor.map(partial(_advance, fitness, lower, upper, settings, target), islands))
        islands = _migrate(islands)
        if progress is not None:
            progress((epoch + 1) / settings.epochs)
    best = min(islands, key=lambda island: float(island.cost.min()))
    index = int(best.cost.argmin())
    return Evolved(best.population[index], float(best.cost[index]), sum(i.evaluations for i in islands))


def _begin(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    settings: Settings,
    start: Floats | None,
    stream: np.random.SeedSequence,
) -> _Island:
    generator = np.random.default_rng(stream)
    population = lower + (upper - lower) * generator.random((settings.population, len(lower)))
    if start is not None:
        population[: len(start)] = np.clip(start, lower, upper)
    half = np.full(_MEMORY, 0.5)
    cost = _evaluate(fitness, population)
    return _Island(population, cost, population[:0], half, half, 0, len(population), generator)


def _evaluate(fitness: Callable[[Floats], Floats], population: Floats) -> Floats:
    return np.nan_to_num(fitness(population), nan=np.inf)


def _advance(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    settings: Settings,
    target: int,
    island: _Island,
) -> _Island:
    population, cost, archive = island.population.copy(), island.cost.copy(), island.archive
    memory_f, memory_cr, slot = island.memory_f.copy(), island.memory_cr.copy(), island.slot
    evaluations, generator = island.evaluations, island.generator
    while evaluations < target:
        n, p = population.shape
        drawn = generator.integers(0, _MEMORY, n)
        crossover = np.clip(generator.normal(memory_cr[drawn], 0.1), 0.0, 1.0)
        factor = _cauchy(memory_f[drawn], generator)
        order = np.argsort(cost, kind="stable")
        best = order[generator.integers(0, max(2, round(_BEST_SHARE * n)), n)]
        first = generator.integers(0, n, n)
        pool = np.concatenate([population, archive])
        second = generator.integers(0, len(pool), n)
        trial = population + factor[:, None] * (population[best] - population + population[first] - pool[second])
        trial = np.where(trial < lower, 0.5 * (population + lower), trial)
        trial = np.where(trial > upper, 0.5 * (population + upper), trial)
        taken = generator.random((n, p)) < crossover[:, None]
        taken[np.arange(n), generator.integers(0, p, n)] = True
        trial = np.where(taken, trial, population)
        trial_cost = _evaluate(fitness, trial)
        evaluations += n
        better = trial_cost < cost
        if better.any():
            gain = np.minimum(cost[better] - trial_cost[better], 1e300)
            share = gain / gain.sum()
            f, cr = factor[better], crossover[better]
            memory_f[slot] = share @ f**2 / (share @ f)  # weighted Lehmer mean
            memory_cr[slot] = share @ cr
            slot = (slot + 1) % _MEMORY
            archive = np.concatenate([archive, population[better]])
            population[better], cost[better] = trial[better], trial_cost[better]
        done = min(1.0, evaluations / settings.evaluations)
        size = round(settings.population + (settings.least_population - settings.population) * done)
        if size < n:
            keep = np.argsort(cost, kind="stable")[:size]
            population, cost = population[keep], cost[keep]
        limit = int(_ARCHIVE * len(population))
        if len(archive) > limit:
            archive = archive[generator.permutation(len(archive))[:limit]]
    return _Island(population, cost, archive, memory_f, memory_cr, slot, evaluations, generator)


def _cauchy(location: Floats, generator: np.random.Generator) -> Floats:
    """Scale factors: Cauchy around `location`, drawn again where not positive, cut at 1."""
    factor = location + 0.1 * generator.standard_cauchy(len(location))
    while (bad := factor <= 0.0).any():
        factor[bad] = location[bad] + 0.1 * generator.standard_cauchy(int(bad.sum()))
    return np.minimum(factor, 1.0)


def _migrate(islands: list[_Island]) -> list[_Island]:
    """The best of each island takes the place of the next island's worst."""
    guests = [(i.population[i.cost.argmin()], float(i.cost.min())) for i in islands]
    for island, (visitor, cost) in zip(islands, guests[-1:] + guests[:-1], strict=True):
        worst = int(island.cost.argmax())
        if cost < island.cost[worst]:
            island.population[worst], island.cost[worst] = visitor, cost
    return islands
