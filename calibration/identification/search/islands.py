"""Differential evolution on islands: success-history adaptation with linear population reduction (L-SHADE).

After Tanabe and Fukunaga, "Improving the search performance of SHADE using linear population size reduction" (CEC
2014); `lshade` says where it differs, and islands and their migration are no part of theirs.
Each island has its own random stream and evolves for an epoch wherever the executor puts it; between epochs its best
candidate visits the next island. Islands and their order are fixed by the seed and random numbers are counted, so the
result depends neither on the executor, nor on the number of its workers, nor on an interruption between two epochs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibration.identification.search import lshade
from calibration.identification.search.checkpoint import Arrays, Checkpoint, keep, pack, problem, unpack
from calibration.identification.search.lshade import Island, Settings
from calibration.observations import Floats

__all__ = ["Evolved", "Settings", "evolve"]


@dataclass(frozen=True)
class Evolved:
    """Result of a search.

    Attributes:
        x: (p,) best candidate.
        cost: its cost.
        evaluations: how many candidates were evaluated, those before an interruption too.
        complete: False if the search was stopped before its end.
        set_aside: why a checkpoint was not continued; None where there was none or it was.
        unsaved: why a checkpoint was not written; None where each was.
    """

    x: Floats
    cost: float
    evaluations: int
    complete: bool = True
    set_aside: str | None = None
    unsaved: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What went wrong with the checkpoint."""
        return tuple(s for s in (self.set_aside, self.unsaved) if s is not None)


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
    should_stop: Callable[[], bool] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Evolved:
    """Minimise `fitness` in a box.

    Args:
        fitness: (candidates, p) -> (candidates,); sent to the executor with every epoch of an island, so picklable
            where that is a process pool (sending `Fitness` costs what evaluating some hundred candidates costs).
        lower, upper: (p,) bounds.
        seed: of all random streams.
        executor: runs the islands.
        settings: how much to search.
        start: (k, p) candidates that every island begins with.
        progress: told the share that is done, after every epoch.
        should_stop: asked after every epoch; the best so far is returned once it says so.
        checkpoint: continued if it holds a state of this very search, and saved after every epoch.

    Raises:
        ValueError: islands of fewer than four candidates.
    """
    if min(settings.population, settings.least_population) < lshade.LEAST:
        raise ValueError(f"an island needs {lshade.LEAST} candidates; the settings are {settings}")
    identity: Arrays = {}
    arrays, set_aside, unsaved = None, None, None
    if checkpoint is not None:
        identity = problem("islands", fitness, lower, upper, start=start, seed=seed, settings=settings)
        arrays, set_aside = unpack(checkpoint.load(), identity)
    if arrays is None:
        first = partial(lshade.begin, fitness, lower, upper, start, seed, settings)
        done, islands = 0, list(executor.map(first, range(settings.islands)))
    else:
        done, islands = _from_arrays(arrays, settings)
    advance = partial(lshade.advance, fitness, lower, upper, seed, settings)
    while done < settings.epochs and not (should_stop is not None and should_stop()):
        target = settings.evaluations * (done + 1) // settings.epochs
        islands = _migrated(list(executor.map(partial(advance, target), islands)))
        done += 1
        if checkpoint is not None:
            unsaved = keep(checkpoint, pack(identity, _to_arrays(done, islands))) or unsaved
        if progress is not None:
            progress(done / settings.epochs)
    best = min(islands, key=lambda island: float(island.cost.min()))
    index = int(best.cost.argmin())
    return Evolved(
        best.population[index].copy(),
        float(best.cost[index]),
        sum(island.evaluations for island in islands),
        done == settings.epochs,
        set_aside,
        unsaved,
    )


def _migrated(islands: Sequence[Island]) -> list[Island]:
    """The best of each island takes the place of the next island's worst; one island alone stays as it is."""
    if len(islands) == 1:
        return list(islands)
    guests = [(i.population[i.cost.argmin()], float(i.cost.min())) for i in islands]
    settled = []
    for island, (visitor, cost) in zip(islands, guests[-1:] + guests[:-1], strict=True):
        worst = int(island.cost.argmax())
        if cost < island.cost[worst]:
            population, costs = island.population.copy(), island.cost.copy()
            population[worst], costs[worst] = visitor, cost
            settled.append(replace(island, population=population, cost=costs))
        else:
            settled.append(island)
    return settled


def _to_arrays(done: int, islands: Sequence[Island]) -> Arrays:
    arrays: Arrays = {"done": np.array(done)}
    for island in islands:
        arrays.update({f"{island.number}.{name}": np.asarray(value) for name, value in vars(island).items()})
    return arrays


def _from_arrays(arrays: Arrays, settings: Settings) -> tuple[int, list[Island]]:
    def island(number: int) -> Island:
        def of(name: str) -> Floats:
            return arrays[f"{number}.{name}"]

        return Island(
            number,
            int(of("generation")),
            int(of("evaluations")),
            of("population"),
            of("cost"),
            of("archive"),
            of("memory"),
            int(of("slot")),
        )

    return int(arrays["done"]), [island(number) for number in range(settings.islands)]
