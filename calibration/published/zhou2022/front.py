"""The Pareto front of the four weights: which errors of the prisms can be had together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.published.zhou2022.objective import WeightedSquares

_MOST_POINTS = 150
_MOST_PARTS = 24
_LEAST_WEIGHT = 0.01


@dataclass(frozen=True)
class WeightPoint:
    """The optimum of Eq. 19 for one set of weights.

    Attributes:
        weight: mu of every prism; their sum is 1.
        rms_mm: RMS error of every prism on poses that were not fitted.
        dominated: another point is better at one prism and worse at none.
    """

    weight: dict[str, float]
    rms_mm: dict[str, float]
    dominated: bool


@dataclass(frozen=True)
class Front:
    """All points, and the one that is taken.

    Attributes:
        points: of the grid of weights.
        chosen: number of the point of the front that is nearest to the best error of every prism, each counted in
            units of that best.
    """

    points: tuple[WeightPoint, ...]
    chosen: int

    @property
    def weight(self) -> dict[str, float]:
        """The chosen weights."""
        return self.points[self.chosen].weight


def pareto_front(fitted: WeightedSquares, judged: WeightedSquares, progress: Callable[[float], None]) -> Front:
    """Optima over a grid of weights, each started from its neighbour's.

    Args:
        fitted: the objective on the poses that are fitted.
        judged: the same on others, whose errors place the points.
        progress: told the share that is done.
    """
    prisms = [name for name in fitted.prisms if name in judged.prisms]
    weights = list(weight_grid(len(prisms)))
    errors = np.empty((len(weights), len(prisms)))
    start: Floats | None = None
    for number, mu in enumerate(weights):
        start = fitted.optimum(dict(zip(prisms, mu, strict=True)), start)
        squares = judged.error_mm(start) ** 2
        of_prism = [judged.chain.rig.prism_names.index(name) for name in prisms]
        errors[number] = [math.sqrt(float(squares[judged.data.prism == prism].mean())) for prism in of_prism]
        progress((number + 1) / len(weights))
    beaten = dominated(errors)
    distance = np.where(beaten, np.inf, ((errors / errors.min(axis=0) - 1.0) ** 2).sum(axis=1))
    points = tuple(
        WeightPoint(dict(zip(prisms, mu, strict=True)), dict(zip(prisms, error.tolist(), strict=True)), bool(worse))
        for mu, error, worse in zip(weights, errors, beaten, strict=True)
    )
    return Front(points, int(distance.argmin()))


def weight_grid(count: int) -> Iterator[tuple[float, ...]]:
    """Weights of `count` prisms, at most 150 sets: an even grid of the simplex, no weight below 0.01.

    Neighbours follow each other, so that one's optimum is a good start for the next.
    """
    parts = max(p for p in range(1, _MOST_PARTS + 1) if math.comb(p + count - 1, count - 1) <= _MOST_POINTS or p == 1)
    spare = 1.0 - count * _LEAST_WEIGHT
    for bars in combinations(range(parts + count - 1), count - 1):
        edges = (-1, *bars, parts + count - 1)
        yield tuple(_LEAST_WEIGHT + spare * (b - a - 1) / parts for a, b in pairwise(edges))


def dominated(errors: Floats | Sequence[Sequence[float]]) -> NDArray[np.bool_]:
    """(m,) which rows of (m, goals) have another row that is nowhere greater and somewhere smaller."""
    table = np.asarray(errors, dtype=np.float64)
    return np.array([bool(((table <= own).all(axis=1) & (table < own).any(axis=1)).any()) for own in table])
