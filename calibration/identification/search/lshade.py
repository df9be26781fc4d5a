"""One island of L-SHADE: current-to-pbest/1/bin with archive; scale factor and crossover rate adapt to success.

A generation is two compiled calls around one evaluation, so that with about eighty candidates an island spends its
time in the fitness. Names and method are those of Tanabe and Fukunaga (CEC 2014), with these differences: crossover
rates are learned by the arithmetic mean of their earlier SHADE (CEC 2013), not by the Lehmer mean, and without a
terminal rate of zero; the archive holds 1.4 times the population, not 2.6 times; the population does not grow with the
number of parameters; a trial with the same cost as its parent is discarded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.identification.search.streams import below, scatter, stream, uniform, word
from calibration.numerics.jit import compiled
from calibration.observations import Floats

_MEMORY = 6  # H
_BEST_SHARE = 0.11  # p
_ARCHIVE = 1.4  # archive size over population size
_SPREAD = 0.1  # of the scale factor and of the crossover rate about their remembered values
LEAST = 4  # candidates of an island, as each is combined with three others
_LARGEST_GAIN = 1e290  # limit for gains from an infinite cost, so that sums stay finite
_ISLAND = 1 << 32  # the numbers of the candidates of island k start at k times this


@dataclass(frozen=True)
class Settings:
    """Budget of a search.

    The defaults suffice to reach a basin from which Gauss-Newton finds the optimum, for about forty parameters that are
    up to 400 mm and 30 deg off. The search itself does not come close to the optimum.

    Attributes:
        islands: number of independent populations.
        population: candidates of each island at the start.
        least_population: candidates of each island at the end.
        evaluations: evaluations by each island.
        epochs: number of parts into which the evaluations are divided. Between two epochs candidates migrate, and a
            search can be stopped or interrupted.
    """

    islands: int = 4
    population: int = 80
    least_population: int = 8
    evaluations: int = 4_000
    epochs: int = 5


@dataclass(frozen=True)
class Island:
    """State of an island of n candidates between two epochs; its arrays are never changed in place.

    Attributes:
        number: number of the island.
        generation: number of generations so far.
        evaluations: number of evaluations of the fitness so far.
        population: (n, p) candidates.
        cost: (n,) costs of the candidates, never NaN.
        archive: (k, p) parents that were replaced.
        memory: (2, H) successful scale factors and crossover rates.
        slot: index of the memory to be written next.
    """

    number: int
    generation: int
    evaluations: int
    population: Floats
    cost: Floats
    archive: Floats
    memory: Floats
    slot: int


def begin(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    start: Floats | None,
    seed: int,
    settings: Settings,
    number: int,
) -> Island:
    """Create an island with candidates drawn uniformly from the box.

    Args:
        fitness: function from (candidates, p) to costs (candidates,).
        lower: (p,) lower bounds.
        upper: (p,) upper bounds.
        start: (k, p) given candidates, which replace the first ones.
        seed: seed of the search.
        settings: budget of the search.
        number: number of the island.
    """
    population = np.empty((settings.population, len(lower)))
    scatter(word(seed), 0, number * _ISLAND, np.array(lower), np.array(upper), population)
    if start is not None:
        given = start[: len(population)]
        population[: len(given)] = np.clip(given, lower, upper)
    cost = fitness(population)
    cost = np.where(np.isnan(cost), np.inf, cost)
    return Island(number, 0, len(population), population, cost, population[:0], np.full((2, _MEMORY), 0.5), 0)


def advance(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    seed: int,
    settings: Settings,
    target: int,
    island: Island,
) -> Island:
    """Evolve generations until the island has spent `target` evaluations.

    Args:
        fitness: function from (candidates, p) to costs (candidates,).
        lower: (p,) lower bounds.
        upper: (p,) upper bounds.
        seed: seed of the search.
        settings: budget of the search.
        target: total evaluations of the island at which to stop.
        island: state to start from, which is not changed.
    """
    lower, upper = np.array(lower), np.array(upper)
    population, cost, memory = np.array(island.population), np.array(island.cost), np.array(island.memory)
    archive = np.empty((max(1, int(_ARCHIVE * len(population))), len(lower)))
    n, archived, slot = len(population), len(island.archive), island.slot
    archive[:archived] = island.archive
    trial, chosen = np.empty_like(population), np.empty((2, n))
    generation, evaluations, key, first = island.generation, island.evaluations, word(seed), island.number * _ISLAND
    while evaluations < target:
        generation += 1
        _propose(
            population[:n], cost[:n], archive[:archived], memory, lower, upper, key, generation, first, trial, chosen
        )
        trial_cost = fitness(trial[:n])
        evaluations += n
        share = min(1.0, evaluations / settings.evaluations)
        size = round(settings.population + (settings.least_population - settings.population) * share)
        n, archived, slot = _select(
            population[:n],
            cost,
            trial,
            trial_cost,
            archive,
            archived,
            memory,
            slot,
            chosen,
            size,
            key,
            generation,
            first,
        )
    return Island(island.number, generation, evaluations, population[:n], cost[:n], archive[:archived], memory, slot)


@compiled
def _propose(
    population: Floats,
    cost: Floats,
    archive: Floats,
    memory: Floats,
    lower: Floats,
    upper: Floats,
    seed: np.uint64,
    generation: int,
    first: int,
    trial: Floats,
    chosen: Floats,
) -> None:
    """Write a trial (n, p) for every candidate, and its scale factor and crossover rate `chosen` (2, n)."""
    n, p = population.shape
    order = np.argsort(cost, kind="mergesort")
    best = max(2, round(_BEST_SHARE * n))
    for i in range(n):
        key = stream(seed, generation, first + i)
        index = below(key, 0, memory.shape[1])
        # A normal number by Box and Muller; a Cauchy number as tangent of a uniform angle, redrawn until positive.
        normal = math.sqrt(-2.0 * math.log(1.0 - uniform(key, 1))) * math.cos(2.0 * math.pi * uniform(key, 2))
        rate = min(1.0, max(0.0, memory[1, index] + _SPREAD * normal))
        draw, factor = 3, 0.0
        while factor <= 0.0:
            factor = memory[0, index] + _SPREAD * math.tan(math.pi * (uniform(key, draw) - 0.5))
            draw += 1
        factor = min(1.0, factor)
        leader = order[below(key, draw, best)]
        other = i
        while other == i:
            draw += 1
            other = below(key, draw, n)
        third = other
        while third in (i, other):
            draw += 1
            third = below(key, draw, n + len(archive))
        far = population[third] if third < n else archive[third - n]
        draw += 1
        forced = below(key, draw, p)
        draw += 1
        for j in range(p):
            parent = population[i, j]
            value = parent
            if j == forced or uniform(key, draw + j) < rate:
                value = parent + factor * (population[leader, j] - parent + population[other, j] - far[j])
                if value < lower[j]:
                    value = 0.5 * (parent + lower[j])
                elif value > upper[j]:
                    value = 0.5 * (parent + upper[j])
            trial[i, j] = value
        chosen[0, i], chosen[1, i] = factor, rate


@compiled
def _select(
    population: Floats,
    cost: Floats,
    trial: Floats,
    trial_cost: Floats,
    archive: Floats,
    archived: int,
    memory: Floats,
    slot: int,
    chosen: Floats,
    size: int,
    seed: np.uint64,
    generation: int,
    first: int,
) -> tuple[int, int, int]:
    """Keep the better of parent and trial, update the memory from successes, drop the worst down to `size`.

    Returns:
        Number of candidates, number of archived parents and the next slot of the memory.
    """
    n, p = population.shape
    total = weighted = squared = rates = 0.0
    for i in range(n):
        if not trial_cost[i] < cost[i]:  # also true if the trial's cost is NaN
            continue
        gain = min(cost[i] - trial_cost[i], _LARGEST_GAIN)
        total += gain
        weighted += gain * chosen[0, i]
        squared += gain * chosen[0, i] ** 2
        rates += gain * chosen[1, i]
        place = archived
        if archived < len(archive):
            archived += 1
        else:
            place = below(stream(seed, generation, first + i), -1, archived)
        for j in range(p):
            archive[place, j] = population[i, j]
            population[i, j] = trial[i, j]
        cost[i] = trial_cost[i]
    if total > 0.0 and weighted > 0.0:
        memory[0, slot] = squared / weighted  # Lehmer mean, weighted by gain
        memory[1, slot] = rates / total
        slot = (slot + 1) % memory.shape[1]
    while n > size:
        worst = np.argmax(cost[:n])
        n -= 1
        cost[worst] = cost[n]
        for j in range(p):
            population[worst, j] = population[n, j]
    limit = int(_ARCHIVE * n)
    while archived > limit:
        place = below(stream(seed, generation, first), -1 - archived, archived)
        archived -= 1
        for j in range(p):
            archive[place, j] = archive[archived, j]
    return n, archived, slot
