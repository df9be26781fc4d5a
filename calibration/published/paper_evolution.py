"""The first paper's parallel differential evolution, exactly as published: DE/rand/1/bin with reflection (Eqs. 6-11).

Mutation draws from the whole population; sub-populations are evaluated in parallel by the executor. The caller mutates
one sub-population while others are evaluated, so that a generation takes little longer than its evaluations. Random
numbers are indexed by candidate, so the result depends neither on the executor, nor on the number of sub-populations,
nor on an interruption.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from calibration.identification.search.checkpoint import Arrays, SavedSearch, problem
from calibration.identification.search.islands import Evolved
from calibration.identification.search.streams import below, scatter, stream, uniform, word
from calibration.numerics.jit import compiled
from calibration.observations import Floats
from calibration.run_settings import Run

_SAVED_EVERY = 20  # generations; a state of the paper's population is nine megabytes
_LEAST = 4  # candidates: mutation needs a candidate and three others


@dataclass(frozen=True)
class PaperSettings:
    """The paper's settings.

    Attributes:
        population: number of candidates.
        generations: number of generations of every search.
        scale_factor: F.
        crossover: Cr; with 1 every dimension comes from the mutant.
        subpopulations: number of parts of the population that are evaluated in parallel.
    """

    population: int = 30_000
    generations: int = 400
    scale_factor: float = 0.5
    crossover: float = 1.0
    subpopulations: int = 16


@dataclass
class _Population:
    """Candidates of one search and their costs; changed in place.

    Attributes:
        generation: number of the generation, from 0.
        candidates: (n, p) parameters.
        cost: (n,) cost of each candidate, never NaN.
    """

    generation: int
    candidates: Floats
    cost: Floats

    def best(self) -> Floats:
        """Return (p,) the candidate with the least cost."""
        best: Floats = self.candidates[int(self.cost.argmin())].copy()
        return best


def evolve_paper(
    fitnesses: Sequence[Callable[[Floats], Floats]],
    judge: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    *,
    run: Run,
    settings: PaperSettings,
) -> Evolved:
    """Search once with every fitness, and return the winner with the least cost by `judge`.

    The paper shuffles its data set and repeats the search: `fitnesses` are the objective on shuffled parts of the
    data (`paper_objective.PaperObjective.shuffled`), `judge` is the objective on all data.

    Args:
        fitnesses: cost functions (candidates, p) -> (candidates,), one search each; they must be picklable if the
            executor is a process pool.
        judge: cost function of the same form.
        lower: (p,) lower bounds.
        upper: (p,) upper bounds.
        run: seed of all random streams, and workers for the sub-populations. Progress and stop are called after every
            generation. The state is saved every 20 generations, and the search resumes from a checkpoint of the same
            search.
        settings: settings of the search.

    Raises:
        ValueError: no fitness, or a population of fewer than four.
    """
    if not fitnesses or settings.population < _LEAST:
        raise ValueError(
            f"{len(fitnesses)} searches of {settings.population} candidates; at least 1 search of {_LEAST} is needed"
        )
    lower, upper = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    cuts = np.linspace(0, settings.population, settings.subpopulations + 1).astype(int)
    parts = [slice(*ends) for ends in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)]
    population, winners = None, []
    saved = SavedSearch(run.checkpoint, lambda: _identity(fitnesses, judge, lower, upper, run.seed, settings))
    if saved.arrays is not None:
        winners = list(saved.arrays["winners"])
        population = _Population(int(saved.arrays["generation"]), saved.arrays["candidates"], saved.arrays["cost"])
    complete, evaluations = True, 0
    with run.workers() as executor:
        for search in range(len(winners), len(fitnesses)):
            fitness, first_stream = fitnesses[search], search * (settings.generations + 1)
            if population is None:
                candidates = np.empty((settings.population, len(lower)))
                scatter(word(run.seed), first_stream, 0, lower, upper, candidates)
                cost = np.concatenate(list(executor.map(fitness, (candidates[part] for part in parts))))
                population = _Population(0, candidates, np.where(np.isnan(cost), np.inf, cost))
            trial = np.empty_like(population.candidates)
            while population.generation < settings.generations:
                if run.should_stop():
                    complete = False
                    break
                _advance(population, fitness, lower, upper, run.seed, first_stream, executor, settings, parts, trial)
                if population.generation % _SAVED_EVERY == 0 or population.generation == settings.generations:
                    saved.save(_arrays(population, winners))
                share = (search * settings.generations + population.generation) / settings.generations
                run.progress(share / len(fitnesses), "the paper's differential evolution")
            winners.append(population.best())
            evaluations = settings.population * (search * (settings.generations + 1) + 1 + population.generation)
            population = None
            if not complete:
                break
    cost = judge(np.array(winners))
    best = int(np.where(np.isnan(cost), np.inf, cost).argmin())
    return Evolved(winners[best], float(cost[best]), evaluations, complete, saved.set_aside, saved.unsaved)


def _advance(
    population: _Population,
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    seed: int,
    first_stream: int,
    executor: Executor,
    settings: PaperSettings,
    parts: Sequence[slice],
    trial: Floats,
) -> None:
    """Advance by one generation. Parents are replaced only after every part has been mutated."""
    generation = population.generation + 1

    def mutated(part: slice) -> Floats:
        _mutate(
            population.candidates,
            lower,
            upper,
            settings.scale_factor,
            settings.crossover,
            word(seed),
            first_stream + generation,
            part.start,
            trial[part],
        )
        return trial[part]

    # Each part is submitted to the executor as soon as it is mutated.
    costs = executor.map(fitness, (mutated(part) for part in parts))
    for part, trial_cost in zip(parts, costs, strict=True):
        _select(population.candidates[part], population.cost[part], trial[part], np.array(trial_cost))
    population.generation = generation


def _identity(
    fitnesses: Sequence[Callable[[Floats], Floats]],
    judge: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    seed: int,
    settings: PaperSettings,
) -> Arrays:
    def all_costs(candidates: Floats) -> Floats:
        return np.concatenate([fitness(candidates) for fitness in (*fitnesses, judge)])

    # Sub-populations only divide the work and do not change the result.
    undivided = replace(settings, subpopulations=1)
    return problem("paper", all_costs, lower, upper, start=None, seed=seed, settings=undivided)


def _arrays(population: _Population, winners: Sequence[Floats]) -> Arrays:
    return {
        "generation": np.array(population.generation),
        "candidates": population.candidates,
        "cost": population.cost,
        "winners": np.array(winners).reshape(len(winners), population.candidates.shape[1]),
    }


@compiled
def _mutate(
    population: Floats,
    lower: Floats,
    upper: Floats,
    scale_factor: float,
    crossover: float,
    seed: np.uint64,
    generation: int,
    first: int,
    trial: Floats,
) -> None:
    """Write trials of the candidates from index `first` on to `trial`, Eqs. 7-10."""
    n, p = population.shape
    for i in range(len(trial)):
        parent = first + i
        key = stream(seed, generation, parent)
        draw = p
        one = two = three = parent
        while one == parent:
            one = below(key, draw, n)
            draw += 1
        while two in (parent, one):
            two = below(key, draw, n)
            draw += 1
        while three in (parent, one, two):
            three = below(key, draw, n)
            draw += 1
        base, left, right, out = population[one], population[two], population[three], trial[i]
        for j in range(p):
            value = base[j] + scale_factor * (left[j] - right[j])
            if value < lower[j]:
                value = min(upper[j], 2.0 * lower[j] - value)
            elif value > upper[j]:
                value = max(lower[j], 2.0 * upper[j] - value)
            out[j] = value
        if crossover < 1.0:
            forced = below(key, draw, p)
            for j in range(p):
                if j != forced and uniform(key, j) >= crossover:
                    out[j] = population[parent, j]


@compiled
def _select(population: Floats, cost: Floats, trial: Floats, trial_cost: Floats) -> None:
    """Replace each candidate by its trial if that has a lower cost, Eq. 11; a trial with cost NaN never wins."""
    n, p = population.shape
    for i in range(n):
        if trial_cost[i] < cost[i]:
            cost[i] = trial_cost[i]
            for j in range(p):
                population[i, j] = trial[i, j]
