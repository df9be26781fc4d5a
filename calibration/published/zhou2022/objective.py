"""The optimum of the paper's weighted objective (Eq. 19): the same unknowns and bounds as its search, converged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.identification.refinement import FLAT_MM, FLAT_RAD
from calibration.kernels.lineariser import Lineariser
from calibration.kinematics import Chain, ChainData, Linearisation
from calibration.observations import Floats

_SETTLED = 1e-9  # relative change of the objective
_ROUNDS = 200
_INSIDE = 0.999  # of the bounds: where a start may be


@dataclass(frozen=True, eq=False)
class WeightedSquares:
    """F = sum over prisms of mu_p e_p^2 / n_p on one data set.

    Attributes:
        chain: kinematics.
        data: (n) bound observations.
        position_mm: (n, 3) measured positions.
        free: (p,) parameters that are searched.
        at: (p,) values of the others.
        width: (k,) bounds of the k free ones, from -width to width; `at` is within.
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
        """The objective on the given rows."""
        return WeightedSquares(
            self.chain, self.data.select(rows), self.position_mm[rows], self.free, self.at, self.width
        )

    def with_base(self) -> WeightedSquares:
        """The same with base and unknown prism offsets searched along, as far as 1 m or 1 rad."""
        flat = np.isinf(self.chain.prior_sigma)
        width = np.array([FLAT_MM if p.unit == "mm" else FLAT_RAD for p in self.chain.parameters]) + np.abs(self.at)
        width[self.free] = self.width
        free = self.free | flat
        return WeightedSquares(self.chain, self.data, self.position_mm, free, self.at, width[free])

    def values(self, found: Floats) -> Floats:
        """(p,) all parameters, from the k free ones."""
        values = self.at.copy()
        values[self.free] = found
        return values

    def error_mm(self, found: Floats) -> Floats:
        """(n,) size of the error of every row."""
        position = self.chain.positions_mm(self.values(found), self.data)
        return np.asarray(np.linalg.norm(self.position_mm - position, axis=1))

    def cost(self, weight: Mapping[str, float], found: Floats) -> float:
        """F, mm^2."""
        return float(((self._scale(weight) * self.error_mm(found)) ** 2).sum())

    def optimum(self, weight: Mapping[str, float], start: Floats | None = None) -> Floats:
        """(k,) where F is least within the bounds: a trust region from `start`, by default from `at`.

        Where the data leave directions open, the result keeps to the start in them.
        """
        scale = np.repeat(self._scale(weight), 3)
        position_mm, data = self.position_mm, self.data
        last: list[tuple[Floats, Linearisation]] = []

        def at(found: Floats) -> Linearisation:
            if not last or not np.array_equal(last[0][0], found):
                last[:] = [(found.copy(), self._lineariser(self.values(found), data))]
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

    @cached_property
    def _lineariser(self) -> Lineariser:
        return Lineariser(self.chain)

    def _scale(self, weight: Mapping[str, float]) -> Floats:
        """(n,) square roots of mu_p / n_p."""
        scale = np.zeros(len(self.data))
        for name, mu in weight.items():
            own = self.data.prism == self.chain.rig.prism_names.index(name)
            if own.any():
                scale[own] = math.sqrt(mu / own.sum())
        return scale
