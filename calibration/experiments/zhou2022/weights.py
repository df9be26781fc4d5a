"""Convergent minimisation of the paper's weighted objective (Eq. 19), and the Pareto front of its four weights.

Unknowns and bounds are those of the paper's search. The front shows the errors of the prisms that are possible
together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.identification.linear_model import FLAT_MM, FLAT_RAD
from calibration.kinematics.chain import Chain, ChainData, Linearisation
from calibration.observations import Floats
from calibration.run_settings import Run

_SETTLED = 1e-9  # relative change of the objective
_ROUNDS = 200
_INSIDE = 0.999  # of the bounds: starting values are clipped to this

_MOST_POINTS = 150
_MOST_PARTS = 24
_LEAST_WEIGHT = 0.01


@dataclass(frozen=True, eq=False)
class WeightedSquares:
    """The objective F = sum over prisms of mu_p e_p^2 / n_p on one data set.

    Attributes:
        chain: kinematics.
        data: (n) bound observations.
        position_mm: (n, 3) measured positions.
        free: (p,) mask of the parameters that are searched.
        at: (p,) values of the other parameters.
        width: (k,) the k free parameters are bounded by -width and width; `at` is within these bounds.
    """

    chain: Chain
    data: ChainData
    position_mm: Floats
    free: NDArray[np.bool_]
    at: Floats
    width: Floats

    @property
    def prisms(self) -> tuple[str, ...]:
        """Names of the prisms that were measured."""
        return tuple(self.chain.rig.prism_names[i] for i in np.unique(self.data.prism))

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> WeightedSquares:
        """Return the objective on the given rows."""
        return WeightedSquares(
            self.chain, self.data.select(rows), self.position_mm[rows], self.free, self.at, self.width
        )

    def with_base(self) -> WeightedSquares:
        """Return the objective that also searches base and unknown prism offsets, up to 1 m or 1 rad beyond `at`."""
        flat = np.isinf(self.chain.prior_sigma)
        width = np.array([FLAT_MM if p.unit == "mm" else FLAT_RAD for p in self.chain.parameters]) + np.abs(self.at)
        width[self.free] = self.width
        free = self.free | flat
        return WeightedSquares(self.chain, self.data, self.position_mm, free, self.at, width[free])

    def values(self, found: Floats) -> Floats:
        """Return (p,) all parameters, given the (k,) free ones."""
        values = self.at.copy()
        values[self.free] = found
        return values

    def error_mm(self, found: Floats) -> Floats:
        """Return (n,) the size of the error of every row, given the (k,) free parameters."""
        position = self.chain.positions_mm(self.values(found), self.data)
        return np.asarray(np.linalg.norm(self.position_mm - position, axis=1))

    def cost(self, weight: Mapping[str, float], found: Floats) -> float:
        """Return F, mm^2, given the weights and the (k,) free parameters."""
        return float(((self._scale(weight) * self.error_mm(found)) ** 2).sum())

    def optimum(self, weight: Mapping[str, float], start: Floats | None = None) -> Floats:
        """Return the (k,) free parameters that minimise F within the bounds, by a trust-region method.

        In directions that the data do not determine, the result stays at the start.

        Args:
            weight: mu of the prisms.
            start: (k,) starting values; those of `at` by default.
        """
        scale = np.repeat(self._scale(weight), 3)
        position_mm, data = self.position_mm, self.data
        last: list[tuple[Floats, Linearisation]] = []

        def at(found: Floats) -> Linearisation:
            if not last or not np.array_equal(last[0][0], found):
                last[:] = [(found.copy(), self.chain.linearise(self.values(found), data))]
            return last[0][1]

        def error(found: Floats) -> Floats:
            return scale * (at(found).position_mm - position_mm).ravel()

        def jacobian(found: Floats) -> Floats:
            return scale[:, None] * at(found).jacobian[:, :, self.free].reshape(len(scale), -1)

        begin = np.clip(self.at[self.free] if start is None else start, -_INSIDE * self.width, _INSIDE * self.width)
        result = least_squares(
            error,
            begin,
            jac=jacobian,
            bounds=(-self.width, self.width),
            x_scale=self.width,
            ftol=_SETTLED,
            xtol=_SETTLED,
            gtol=None,
            max_nfev=_ROUNDS,
        )
        found: Floats = result.x
        return found

    def _scale(self, weight: Mapping[str, float]) -> Floats:
        """Return (n,) square roots of mu_p / n_p."""
        scale = np.zeros(len(self.data))
        for name, mu in weight.items():
            own = self.data.prism == self.chain.rig.prism_names.index(name)
            if own.any():
                scale[own] = math.sqrt(mu / own.sum())
        return scale


@dataclass(frozen=True)
class WeightPoint:
    """The optimum of Eq. 19 for one set of weights.

    Attributes:
        weight: mu of every prism; their sum is 1.
        rms_mm: RMS error of every prism on poses that were not fitted.
        dominated: True if another point is better for one prism and not worse for any.
    """

    weight: dict[str, float]
    rms_mm: dict[str, float]
    dominated: bool


@dataclass(frozen=True)
class Front:
    """Errors of the prisms at every point of a grid of weights, and the chosen point.

    Attributes:
        points: points of the grid of weights.
        chosen: index of the point of the front that is nearest to the best errors of all prisms; each error is measured
            in units of the best error of its prism.
    """

    points: tuple[WeightPoint, ...]
    chosen: int

    @property
    def weight(self) -> dict[str, float]:
        """The chosen weights."""
        return self.points[self.chosen].weight


def pareto_front(fitted: WeightedSquares, judged: WeightedSquares, run: Run) -> Front:
    """Compute the optima over a grid of weights, each started from the optimum of its neighbour.

    Args:
        fitted: the objective on the poses that are fitted.
        judged: the objective on other poses, which give the errors of the points.
        run: receives the progress.
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
        run.progress((number + 1) / len(weights), "Pareto front of the weights")
    beaten = dominated(errors)
    distance = np.where(beaten, np.inf, ((errors / errors.min(axis=0) - 1.0) ** 2).sum(axis=1))
    points = tuple(
        WeightPoint(dict(zip(prisms, mu, strict=True)), dict(zip(prisms, error.tolist(), strict=True)), bool(worse))
        for mu, error, worse in zip(weights, errors, beaten, strict=True)
    )
    return Front(points, int(distance.argmin()))


def weight_grid(count: int) -> Iterator[tuple[float, ...]]:
    """Yield weights of `count` prisms, at most 150 sets: a uniform grid of the simplex, with no weight below 0.01.

    Successive sets are neighbours, so that the optimum of one is a good start for the next.
    """
    parts = max(p for p in range(1, _MOST_PARTS + 1) if math.comb(p + count - 1, count - 1) <= _MOST_POINTS or p == 1)
    spare = 1.0 - count * _LEAST_WEIGHT
    for bars in combinations(range(parts + count - 1), count - 1):
        edges = (-1, *bars, parts + count - 1)
        yield tuple(_LEAST_WEIGHT + spare * (b - a - 1) / parts for a, b in pairwise(edges))


def dominated(errors: Floats | Sequence[Sequence[float]]) -> NDArray[np.bool_]:
    """Return an (m,) mask of dominated rows: another row is nowhere greater and somewhere smaller.

    Args:
        errors: (m, objectives).
    """
    table = np.asarray(errors, dtype=np.float64)
    return np.array([bool(((table <= own).all(axis=1) & (table < own).any(axis=1)).any()) for own in table])
