"""Differential evolution on islands: success-history adaptation with linear population reduction (L-SHADE).

After Tanabe and Fukunaga, "Improving the search performance of SHADE using linear population size reduction" (CEC
2014); `lshade` says where it differs, and islands and their migration are no part of theirs.
Each island has its own random stream and evolves for an epoch wherever the executor puts it; between epochs its best
candidate visits the next island. Islands and their order are fixed by the seed and random numbers are counted, so the
result depends neither on the executor, nor on the number of its workers, nor on an interruption between two epochs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from calibration.identification.search import lshade
from calibration.identification.search.checkpoint import Arrays, SavedSearch, problem
from calibration.identification.search.lshade import Island, Settings
from calibration.observations import Floats
from calibration.run_settings import Run

__all__ = ["Evolved", "Settings", "evolve"]


@dataclass(frozen=True)
class Evolved:
    """Result of a search.

    Attributes:
        x: (p,) best candidate.
        cost: its cost.
        evaluations: number of candidates that were evaluated, those before an interruption too.
        complete: False if the search was stopped before its end.
        set_aside: reason why a checkpoint was not continued; None where there was none or it was.
        unsaved: reason why a checkpoint was not written; None where each was.
    """

    x: Floats
    cost: float
    evaluations: int
    complete: bool = True
    set_aside: str | None = None
    unsaved: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on a checkpoint that was not continued or not written."""
        return tuple(s for s in (self.set_aside, self.unsaved) if s is not None)


def evolve(
    fitness: Callable[[Floats], Floats],
    lower: Floats,
    upper: Floats,
    *,
    run: Run,
    settings: Settings,
    start: Floats | None = None,
) -> Evolved:
    """Minimise `fitness` in a box.

    Args:
        fitness: function from (candidates, p) to costs (candidates,); sent to the executor with every epoch of an
            island, so picklable where that is a process pool (sending `Fitness` costs as much as evaluating some
            hundred candidates).
        lower: (p,) bounds.
        upper: (p,) bounds.
        run: seed of all random streams, workers for the islands; it is reported to, asked to stop and saved after
            every epoch, and goes on from a checkpoint of this very search.
        settings: budget.
        start: (k, p) candidates that every island begins with.

    Raises:
        ValueError: islands of fewer than four candidates.
    """
    if min(settings.population, settings.least_population) < lshade.LEAST:
        raise ValueError(f"an island needs {lshade.LEAST} candidates; the settings are {settings}")
    identity = partial(problem, "islands", fitness, lower, upper, start=start, seed=run.seed, settings=settings)
    saved = SavedSearch(run.checkpoint, identity)
    with run.workers() as executor:
        if saved.arrays is None:
            first = partial(lshade.begin, fitness, lower, upper, start, run.seed, settings)
            done, islands = 0, list(executor.map(first, range(settings.islands)))
        else:
            done, islands = _from_arrays(saved.arrays, settings)
        advance = partial(lshade.advance, fitness, lower, upper, run.seed, settings)
        while done < settings.epochs and not run.should_stop():
            target = settings.evaluations * (done + 1) // settings.epochs
            islands = _migrated(list(executor.map(partial(advance, target), islands)))
            done += 1
            saved.save(_to_arrays(done, islands))
            run.progress(done / settings.epochs, "searching globally")
    best = min(islands, key=lambda island: float(island.cost.min()))
    index = int(best.cost.argmin())
    return Evolved(
        best.population[index].copy(),
        float(best.cost[index]),
        sum(island.evaluations for island in islands),
        done == settings.epochs,
        saved.set_aside,
        saved.unsaved,
    )


def _migrated(islands: Sequence[Island]) -> list[Island]:
    """Put the best of each island in the place of the next one's worst; one island alone stays as it is."""
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
        parts: dict[str, Any] = {}
        for field in fields(Island):
            value = arrays[f"{number}.{field.name}"]
            parts[field.name] = value if value.ndim else int(value)
        return Island(**parts)

    return int(arrays["done"]), [island(number) for number in range(settings.islands)]
