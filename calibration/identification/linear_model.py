"""Linearisation of samples about given parameters: errors, derivatives and noise.

Rows are sorted by standstill, as the fixes of one standstill share random errors of their readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.effects.columns import EffectColumns
from calibration.identification.noise import Marginals, Whitening, factorise, marginals
from calibration.identification.samples import Samples
from calibration.kinematics.chain import Chain
from calibration.observations import Floats

Flags = NDArray[np.bool_]

FLAT_MM = 1e3  # of unknown parameters: too wide to affect anything measured, finite so that no matrix is singular
FLAT_RAD = 1.0


def prior_precision(chain: Chain, scale: float) -> Floats:
    """Return (p,) 1 / sigma^2 of every parameter's prior, with build tolerances multiplied by `scale`."""
    flat = np.array([FLAT_MM if p.unit == "mm" else FLAT_RAD for p in chain.parameters])
    sigma = np.where(np.isinf(chain.prior_sigma), flat, chain.prior_sigma * scale)
    return 1.0 / sigma**2


@dataclass(frozen=True)
class Linearised:
    """Errors and derivatives of m rows at `x` (p + k,).

    Attributes:
        x: parameters and coefficients.
        error: (m, 3) measured minus modelled, mm.
        jacobian: (m, 3, p + k) derivatives by parameters and coefficients.
        by_joint: (m, 3, joints) derivatives by readings.
    """

    x: Floats
    error: Floats
    jacobian: Floats
    by_joint: Floats


class LinearModel:
    """Model of samples that can be linearised at given parameters.

    Args:
        chain: kinematics, p parameters.
        samples: m rows.
        free: (p,) or (p + k,) mask of what a fit may change; all by default, and all coefficients if it has p entries.
        additions: k coefficients of effects, with columns for the m rows.

    Attributes:
        chain: kinematics.
        order: (m,) sample of each row.
        free: (p + k,) mask of the parameters and coefficients that the fit may change.
        tolerated: (p + k,) mask of those among them that have a build tolerance.

    Raises:
        ValueError: the number of rows of the additions differs from m.
    """

    def __init__(
        self,
        chain: Chain,
        samples: Samples,
        free: Flags | None = None,
        additions: EffectColumns | None = None,
    ) -> None:
        if additions is not None and len(additions.column) != len(samples):
            raise ValueError(f"additions have {len(additions.column)} rows for {len(samples)} samples")
        self.order = np.argsort(samples.standstill, kind="stable")
        self._is_in_order = bool((np.diff(self.order) > 0).all())
        following = np.flatnonzero(np.diff(samples.standstill[self.order])) + 1
        self._start = np.concatenate([[0], following, [len(samples)]]).astype(np.intp)
        self.chain = chain
        self._added = additions.select(self.order) if additions is not None else None
        self._data = samples.data.select(self.order)
        self._position_mm = samples.position_mm[self.order]
        self._station = samples.station_covariance[self.order]
        self._rates = samples.rates[self.order] * chain.rig.station.timing_sigma_s
        self._shared = samples.shared_variance(chain.rig)[self.order]
        self._variance = self._shared + samples.own_variance(chain.rig)[self.order]
        added = np.zeros(0) if additions is None else additions.prior_sigma
        self._added_precision = 1.0 / added**2
        given = np.ones(0, dtype=bool) if free is None else free
        self.free = np.concatenate([given, np.ones(len(chain) + len(added) - len(given), dtype=bool)])
        self.tolerated = self.free & np.concatenate([np.isfinite(chain.prior_sigma), np.zeros(len(added), dtype=bool)])

    def extended(self, x: Floats) -> Floats:
        """Append zeros to `x` for the coefficients that it lacks."""
        return np.concatenate([x, np.zeros(len(self.free) - len(x))])

    def precision(self, scale: float) -> Floats:
        """Return the prior precision of all free values; `scale` multiplies build tolerances, not priors of effects."""
        precision: Floats = np.concatenate([prior_precision(self.chain, scale), self._added_precision])[self.free]
        return precision

    def at(self, x: Floats) -> Linearised:
        """Linearise at `x` (p + k,)."""
        p = len(self.chain)
        if self._added is None:
            position, jacobian, by_joint = self.chain.linearise(x, self._data)
        else:
            kinematics = partial(self.chain.linearise, x[:p])
            position, jacobian, by_joint = self._added.linearise(kinematics, self._data, x[p:])
        return Linearised(x, self._position_mm - position, jacobian, by_joint)

    def marginals(self, state: Linearised, excess: float) -> Marginals:
        """Return the covariance of every row by itself.

        Args:
            state: rows linearised at some parameters.
            excess: excess variance s^2, mm^2 per axis.
        """
        velocity = (state.by_joint @ self._rates[:, :, None])[:, :, 0]
        return marginals(self._station, velocity, state.by_joint, self._variance, excess, state.error)

    def whitening(self, state: Linearised, of_rows: Marginals, weight: Floats) -> Whitening:
        """Factor the covariance of all rows.

        Args:
            state: rows linearised at some parameters.
            of_rows: result of `marginals` there.
            weight: (m,) probability that a row is no outlier.
        """
        return factorise(self._start, of_rows, state.by_joint, self._shared, weight)

    def by_row(self, values: Floats) -> Floats:
        """Sort values (m, ...) of the samples into the order of the rows; the inverse of `by_sample`."""
        return values if self._is_in_order else values[self.order]

    def by_sample(self, values: Floats) -> Floats:
        """Sort values (m, ...) of the rows into the order of the samples; no copy if both orders are the same."""
        if self._is_in_order:
            return values
        out = np.empty_like(values)
        out[self.order] = values
        return out


def information(
    chain: Chain,
    samples: Samples,
    x: Floats,
    *,
    excess_variance: float,
    weight: Floats | None = None,
    additions: EffectColumns | None = None,
) -> Floats:
    """Return the information J' V^-1 J of the samples on the parameters, (p, p) or (p + k, p + k), without a prior.

    Args:
        chain: kinematics.
        samples: m rows.
        x: (p,) parameters; with k additions also (p + k,).
        excess_variance: s^2, mm^2 per axis.
        weight: (m,) probability that a sample is no outlier; 1 by default.
        additions: k coefficients of effects, with columns for the m rows.
    """
    model = LinearModel(chain, samples, additions=additions)
    state = model.at(model.extended(x))
    given = np.ones(len(samples)) if weight is None else weight[model.order]
    whitened = model.whitening(state, model.marginals(state, excess_variance), given).whiten(state.jacobian)
    matrix: Floats = whitened.T @ whitened
    return matrix
