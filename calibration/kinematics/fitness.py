"""Compiled fitness of whole populations of candidate parameters.

A candidate's transforms are first reduced to one step for each driven rotation (`chain_reduction`). Then every step
runs over the observations (`population_loops`), in the order planned by `layout`. `Chain.positions_mm` computes the
same positions for a single candidate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain, ChainData
from calibration.kinematics.chain_reduction import Integers, SegmentTree, reduce_chain
from calibration.kinematics.layout import Planner
from calibration.kinematics.population_loops import fitness as compiled_fitness
from calibration.observations import Floats

_TOGETHER = 512  # candidates whose constants are in memory at a time
_PLAIN: Sequence[Literal["C", "A", "W"]] = ("C", "A", "W")  # requirements for arrays that are passed to numba


@dataclass(frozen=True)
class Fitness:
    """Weighted sum of squared position errors of every candidate of a population; picklable, callable.

    Called with (candidates, p) parameters, it returns (candidates,) sums of weight * |error|^2. With `robust_scale` c
    it returns sums of u / (1 + u / c^2), u = weight * |error|^2 (Geman-McClure), which gross outliers cannot dominate.
    The cost of a candidate whose positions overflow is infinity or NaN. A call runs in one thread without the
    interpreter's lock, and raises ValueError if the number of parameters is wrong.

    Attributes:
        parameters: number of parameters of a candidate.
        tree: the constant parts of the chain.
        arguments: arguments of the compiled function between a candidate's constants and the result.
    """

    parameters: int
    tree: SegmentTree
    arguments: tuple[Any, ...]

    @classmethod
    def build(
        cls,
        chain: Chain,
        data: ChainData,
        position_mm: Floats,
        weight: Floats,
        robust_scale: float = math.inf,
        *,
        free: NDArray[np.bool_] | None = None,
        at: Floats | None = None,
        precision: Literal["float64", "float32"] = "float64",
        pairs: Integers | None = None,
        pair_weight: Floats | None = None,
    ) -> Fitness:
        """Prepare the observations.

        Args:
            chain: kinematics.
            data: (n) bound observations.
            position_mm: (n, 3) measured positions.
            weight: (n,) weight of each squared error, 1/mm^2.
            robust_scale: c, in units of sqrt(weight) * mm; infinity for plain squares.
            free: (p,) mask of the parameters that form a candidate, in the chain's order; all if left out.
            at: (p,) values of the other parameters; zero if left out.
            precision: precision of the loops over observations; a candidate's constants and the sums over chunks of
                observations are always float64. With float32 the error of a prism's position is about 1e-3 mm at 10 m
                of reach, and the relative error of the sums is 1e-6 for errors of 100 mm and more, 2e-5 at 5 mm, and
                1e-3 at 0.3 mm.
            pairs: (k, 2) rows i, j of `data`; each pair adds pair_weight * |error_i - error_j|^2 (the error of the
                direction between two prisms), with the same robust function.
            pair_weight: (k,) weights of the pairs, 1/mm^2; ones if left out.
        """
        p = len(chain)
        free = np.ones(p, dtype=bool) if free is None else free
        planner = Planner(chain, free, np.zeros(p) if at is None else at)
        tree, layout = planner.plan(data, position_mm, weight)
        pairs = np.empty((0, 2), dtype=np.intp) if pairs is None else pairs
        arguments = (
            layout.todo,
            layout.chunk,
            *(values.astype(precision) for values in (layout.table, layout.length, layout.target)),
            layout.turns,
            layout.lengths,
            layout.place[pairs],
            np.ones(len(pairs)) if pair_weight is None else np.array(pair_weight, dtype=np.float64),
            0.0 if math.isinf(robust_scale) else 1.0 / robust_scale**2,
        )
        return cls(int(free.sum()), tree, arguments)

    def __call__(self, population: Floats) -> Floats:
        candidates: Floats = np.require(population, np.float64, _PLAIN)
        if candidates.ndim != 2 or candidates.shape[1] != self.parameters:
            raise ValueError(f"candidates have shape {candidates.shape}; they need {self.parameters} columns")
        out = np.empty(len(candidates))
        for first in range(0, len(candidates), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            compiled_fitness(*(*reduce_chain(self.tree, candidates[part]), *self.arguments, out[part]))
        return out

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Executors may pass read-only arrays, for which numba would compile everything again.
        def own(values: tuple[Any, ...]) -> list[Any]:
            return [np.require(v, requirements=_PLAIN) if isinstance(v, np.ndarray) else v for v in values]

        restored = {**state, "tree": SegmentTree(*own(state["tree"])), "arguments": tuple(own(state["arguments"]))}
        for name, value in restored.items():
            object.__setattr__(self, name, value)


def evaluate(fitness: Callable[[Floats], Floats], population: Floats, executor: Executor, pieces: int) -> Floats:
    """Evaluate a population in pieces, in parallel.

    The fitness of a candidate does not depend on the number of pieces or the executor.

    Args:
        fitness: (candidates, p) -> (candidates,); picklable if the executor requires that.
        population: (candidates, p) parameters.
        executor: evaluates the pieces.
        pieces: number of consecutive pieces into which the population is divided; a few for each worker.
    """
    return np.concatenate(list(executor.map(fitness, np.array_split(population, pieces))))
