"""Gauss-Newton to the optimum: whitened residuals, build-tolerance priors, outliers weighted out, noise estimated.

The model of an observation: with probability 1 - epsilon its error is normal with the covariance
Sigma_station + J_q Sigma_q J_q' + timing + s^2 I, else thirty times as wide. s^2 is what the data's own scatter adds,
so that small sigma columns never make the fit chase a few rows when what the kinematics lack dominates. It is found by
restricted maximum likelihood (the parameters' degrees of freedom do not count as noise), epsilon by
expectation-maximisation, and the prior's scale, where asked for, by MacKay's evidence update.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import expit

from calibration.errors import CalibrationError
from calibration.identification.samples import Samples, reading_covariance
from calibration.kinematics import Chain, Linearisation
from calibration.observations import Floats

FLAT_MM = 1e3  # "unknown": wide enough to pull on nothing that is measured, finite so that nothing is singular
FLAT_RAD = 1.0
_ROUNDS = 100
# Wide: a tenth of the rows a few sigma off are what the kinematics lack, which must raise s^2, and no outliers.
_OUTLIER_WIDTH = 30.0
_OUTLIER_SHARE = (1e-3, 0.4)
_PRIOR_SCALE = (0.1, 300.0)
_AS_BUILT_SCALE = 30.0
_DAMPING = (1e-9, 1e9)
_SETTLED = 1e-3


@dataclass(frozen=True)
class Fit:
    """Result of `refine`.

    Attributes:
        x: (p,) parameters.
        covariance: (p, p) posterior covariance; zero rows for parameters that were held.
        excess_variance: s^2, mm^2 per axis.
        prior_scale: what the build tolerances were multiplied by.
        outlier_share: epsilon.
        weight: (m,) probability that a sample is no outlier.
        cost: negative log posterior at the solution; lower is better on the same samples.
        settled: False if the iteration ended before it came to rest.
    """

    x: Floats
    covariance: Floats
    excess_variance: float
    prior_scale: float
    outlier_share: float
    weight: Floats
    cost: float
    settled: bool


@dataclass(frozen=True)
class _State:
    x: Floats
    lin: Linearisation
    error: Floats  # (m, 3) measured minus modelled
    known: Floats  # (m, 3, 3) covariance without the excess


def prior_precision(chain: Chain, scale: float) -> Floats:
    """(p,) 1 / sigma^2 of every parameter's prior."""
    flat = np.array([FLAT_MM if p.unit == "mm" else FLAT_RAD for p in chain.parameters])
    sigma = np.where(np.isinf(chain.prior_sigma), flat, chain.prior_sigma * scale)
    return 1.0 / sigma**2


def refine(
    chain: Chain,
    samples: Samples,
    start: Floats,
    *,
    free: NDArray[np.bool_] | None = None,
    prior: Literal["recalibration", "as-built"] = "recalibration",
    excess_variance: float | None = None,
) -> Fit:
    """Find the maximum of the posterior near `start`.

    Args:
        chain: kinematics.
        samples: m rows.
        start: (p,) parameters.
        free: (p,) which parameters move; all by default.
        prior: trust the build tolerances, or estimate one factor on all of them.
        excess_variance: hold s^2 at this value instead of estimating it.

    Raises:
        CalibrationError: the numbers left the range of floating point.
    """
    free = np.ones(len(chain), dtype=bool) if free is None else free
    tolerated = free & np.isfinite(chain.prior_sigma)
    scale = _AS_BUILT_SCALE if prior == "as-built" else 1.0
    state = _state(chain, samples, start)
    robust = float(np.median(np.linalg.norm(state.error, axis=1))) / 1.54  # median of a 3-D normal's norm
    excess = max(robust**2, 1e-12) if excess_variance is None else excess_variance
    share, damping, settled = 0.05, 1e-3, False
    weight = np.ones(len(samples))
    for _ in range(_ROUNDS):
        precision = prior_precision(chain, scale)
        inverse = _inverses(state.known, excess)
        before = weight
        weight = _inlier_probability(state.error, inverse, share)
        share = float(np.clip(1.0 - weight.mean(), *_OUTLIER_SHARE))
        normal, gradient = _normal(state, inverse, weight, precision, free)
        moved, damping, step = _step(chain, samples, state, free, normal, gradient, weight, inverse, precision, damping)
        change = 0.0
        if excess_variance is None:
            renewed = _excess(state, weight, excess, normal, gradient, free)
            change = abs(renewed - excess) / (excess + float(np.trace(state.known, axis1=1, axis2=2).mean()) / 3.0)
            excess = renewed
        if prior == "as-built" and tolerated.any():
            renewed = _prior_scale(moved.x, tolerated, free, _inverse(normal), chain.prior_sigma, scale)
            change = max(change, abs(math.log(renewed / scale)))
            scale = renewed
        state = moved
        if step < _SETTLED and change < _SETTLED and np.abs(weight - before).max() < 10 * _SETTLED:
            settled = True
            break
    precision = prior_precision(chain, scale)
    inverse = _inverses(state.known, excess)
    weight = _inlier_probability(state.error, inverse, share)
    normal, _ = _normal(state, inverse, weight, precision, free)
    covariance = np.zeros((len(chain), len(chain)))
    covariance[np.ix_(free, free)] = _inverse(normal)
    cost = _cost(state, inverse, share, precision, free, normal)
    if not math.isfinite(cost):
        raise CalibrationError("identification: the fit left the range of numbers; check units of the observations")
    return Fit(state.x, covariance, excess, scale, share, weight, cost, settled)


def _state(chain: Chain, samples: Samples, x: Floats) -> _State:
    lin = chain.linearise(x, samples.data)
    known = samples.station_covariance + reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    return _State(x, lin, samples.position_mm - lin.position_mm, known)


def _inverses(known: Floats, excess: float) -> Floats:
    """(m, 3, 3) inverse covariance of the samples."""
    return np.asarray(np.linalg.inv(known + excess * np.eye(3)), dtype=np.float64)


def _square(error: Floats, inverse: Floats) -> Floats:
    """(m,) squared Mahalanobis lengths."""
    square: Floats = np.einsum("ni,nij,nj->n", error, inverse, error)
    return square


def _inlier_probability(error: Floats, inverse: Floats, share: float) -> Floats:
    odds = math.log((1.0 - share) / share) + 3.0 * math.log(_OUTLIER_WIDTH)
    probability: Floats = expit(odds - 0.5 * _square(error, inverse) * (1.0 - _OUTLIER_WIDTH**-2))
    return probability


def _normal(
    state: _State, inverse: Floats, weight: Floats, precision: Floats, free: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Normal matrix with the prior and the gradient that its inverse turns into a step."""
    jacobian = state.lin.jacobian[:, :, free]
    weighted = (weight[:, None, None] * inverse) @ jacobian
    columns = jacobian.shape[2]
    normal = jacobian.reshape(-1, columns).T @ weighted.reshape(-1, columns) + np.diag(precision[free])
    gradient = weighted.reshape(-1, columns).T @ state.error.ravel() - precision[free] * state.x[free]
    return normal, gradient


def _factor(matrix: Floats) -> tuple[Floats, tuple[Floats, bool]]:
    """Cholesky factor of the matrix scaled to a unit diagonal, and the scale."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return scale, cho_factor(matrix * scale[:, None] * scale, lower=True)


def _inverse(matrix: Floats) -> Floats:
    scale, factor = _factor(matrix)
    inverse: Floats = cho_solve(factor, np.eye(len(matrix))) * scale[:, None] * scale
    return inverse


def _step(
    chain: Chain,
    samples: Samples,
    state: _State,
    free: NDArray[np.bool_],
    normal: Floats,
    gradient: Floats,
    weight: Floats,
    inverse: Floats,
    precision: Floats,
    damping: float,
) -> tuple[_State, float, float]:
    """One damped step that does not raise the weighted squares; the new state, damping and step size in sigma."""

    def squares(at: _State) -> float:
        return float(weight @ _square(at.error, inverse) + precision[free] @ at.x[free] ** 2)

    here = squares(state)
    while damping < _DAMPING[1]:
        try:
            scale, factor = _factor(normal + damping * np.diag(np.diag(normal)))
        except LinAlgError:
            damping *= 10.0
            continue
        step = scale * cho_solve(factor, scale * gradient)
        x = state.x.copy()
        x[free] += step
        moved = _state(chain, samples, x)
        if squares(moved) <= here * (1.0 + 1e-12):
            size = math.sqrt(max(0.0, float(step @ normal @ step) / len(step)))
            return moved, max(damping / 10.0, _DAMPING[0]), size
        damping *= 10.0
    return state, 1e-3, 0.0


def _excess(
    state: _State, weight: Floats, excess: float, normal: Floats, gradient: Floats, free: NDArray[np.bool_]
) -> float:
    """A few rising steps of the restricted likelihood in s^2, on the linearised model.

    Each multiplies s^2 by sqrt(e' V^-2 e / tr P), V the covariance, e the error after the parameters' step and
    P = V^-1 - V^-1 J C J' V^-1 (the minorise-maximise update for variance components).
    """
    jacobian = state.lin.jacobian[:, :, free]
    columns = jacobian.shape[2]
    covariance = _inverse(normal)
    error = state.error - jacobian @ (covariance @ gradient)
    for _ in range(3):
        inverse = _inverses(state.known, excess)
        twice = inverse @ inverse
        squares = float(weight @ _square(error, twice))
        fitted = (weight[:, None, None] ** 2 * twice @ jacobian).reshape(-1, columns)
        taken = float(np.sum((jacobian.reshape(-1, columns).T @ fitted) * covariance))
        left = float(weight @ np.trace(inverse, axis1=1, axis2=2)) - taken
        if left <= 0.0:
            break
        excess = max(excess * math.sqrt(squares / left), 1e-12)
    return excess


def _prior_scale(
    x: Floats,
    tolerated: NDArray[np.bool_],
    free: NDArray[np.bool_],
    covariance: Floats,
    sigma: Floats,
    scale: float,
) -> float:
    """MacKay: scale^2 = sum of (x / sigma)^2 over the number of parameters that the data determine."""
    inside = tolerated[free]
    variance = np.diag(covariance)[inside] / (sigma[tolerated] * scale) ** 2
    determined = float(np.sum(1.0 - variance))
    squares = float(np.sum((x[tolerated] / sigma[tolerated]) ** 2))
    return float(np.clip(math.sqrt(squares / max(determined, 1.0)), *_PRIOR_SCALE))


def _cost(
    state: _State, inverse: Floats, share: float, precision: Floats, free: NDArray[np.bool_], normal: Floats
) -> float:
    """Negative log evidence (Laplace), up to a constant: fits of one data set from different starts compare by it."""
    square = _square(state.error, inverse)
    volume = 0.5 * np.linalg.slogdet(inverse)[1]
    inlier = math.log(1.0 - share) + volume - 0.5 * square
    outlier = math.log(share) + volume - 3.0 * math.log(_OUTLIER_WIDTH) - 0.5 * square / _OUTLIER_WIDTH**2
    likelihood = float(np.logaddexp(inlier, outlier).sum())
    prior = 0.5 * float(np.sum(np.log(precision[free])) - precision[free] @ state.x[free] ** 2)
    scale = 1.0 / np.sqrt(np.diag(normal))
    determinant = float(np.linalg.slogdet(normal * scale[:, None] * scale)[1]) - 2.0 * float(np.sum(np.log(scale)))
    return -(likelihood + prior - 0.5 * determinant)
