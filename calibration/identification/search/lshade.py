"""One island of L-SHADE: current-to-pbest/1/bin with archive, scale factor and crossover learned from success.

A generation is two compiled calls around one evaluation, so that with some eighty candidates an island spends its time
in the fitness. Names are those of Tanabe and Fukunaga (CEC 2014), and so is the method but for this: crossover rates
are learned by the arithmetic mean that their earlier SHADE (CEC 2013) has, not by the Lehmer mean, and no memory ends
at a terminal rate of zero; the archive holds 1.4 candidates for each of the population, not 2.6; the population does
not grow with the parameters; a trial as costly as its parent is dropped.
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
_SPREAD = 0.1  # of the scale factor and of the crossover rate around their memories
LEAST = 4  # candidates of an island: one and three others
_LARGEST_GAIN = 1e290  # a gain from an infinite cost, such that sums stay finite
_ISLAND = 1 << 32  # candidates of island k are numbered from k times this


@dataclass(frozen=True)
class Settings:
    """Budget of a search.

    The defaults lead into the basin that Gauss-Newton finishes in, for some forty parameters that are up to 400 mm and
    30 deg off; they end nowhere near the optimum themselves.

    Attributes:
        islands: independent populations.
        population: candidates of each island at the start.
        least_population: and at the end.
        evaluations: of each island.
        epochs: pieces the evaluations are cut into; migration happens between them, and a search can be stopped or
            interrupted there.
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
        number: of the island.
        generation: how many generations it has seen.
        evaluations: of the fitness.
        population: (n, p).
        cost: (n,), never NaN.
        archive: (k, p) parents that were replaced.
        memory: (2, H) successful scale factors and crossover rates.
        slot: of the memory that is written next.
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
    """Draw candidates uniformly from the box, the given ones (k, p) in front."""
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
    """Evolve generations until the island has spent `target` evaluations."""
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
    """Write a trial (n, p) for every candidate and the scale factor and crossover rate (2, n) that made it."""
    n, p = population.shape
    order = np.argsort(cost, kind="mergesort")
    best = max(2, round(_BEST_SHARE * n))
    for i in range(n):
        key = stream(seed, generation, first + i)
        index = below(key, 0, memory.shape[1])
        # Box and Muller's normal; a Cauchy number is the tangent of a uniform angle, drawn again until positive.
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
    """Keep the better of parent and trial, learn from what succeeded, drop the worst down to `size`.

    Returns:
        Candidates, archived parents and the next slot of the memory.
    """
    n, p = population.shape
    total = weighted = squared = rates = 0.0
    for i in range(n):
        if not trial_cost[i] < cost[i]:  # nor where the trial has no cost
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
        memory[0, slot] = squared / weighted  # Lehmer mean, weighted by what was gained
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
