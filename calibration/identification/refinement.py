"""Gauss-Newton to the optimum: whitened residuals, build-tolerance priors, outliers weighted out, noise estimated.

The model of an observation: with probability 1 - epsilon its error is normal with the covariance
Sigma_station + J_q Sigma_q J_q' + timing + s^2 I, else thirty times as wide; inliers of one standstill are correlated,
as they share errors of its readings (`whitening`). s^2 is what the data's own scatter adds, so that small sigma
columns never make the fit chase a few rows when what the kinematics lack dominates. It is found by restricted maximum
likelihood (the parameters' degrees of freedom do not count as noise), epsilon by expectation-maximisation, and the
prior's scale, where asked for, by MacKay's evidence update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import expit

from calibration.errors import CalibrationError
from calibration.identification.additions import Additions
from calibration.identification.samples import Samples
from calibration.identification.whitening import Marginals, Whitening, factorise, marginals
from calibration.kernels.gram import gram
from calibration.kernels.lineariser import Lineariser
from calibration.kinematics import Chain, ChainData
from calibration.observations import Floats

Flags = NDArray[np.bool_]
Prior = Literal["recalibration", "as-built"]

FLAT_MM = 1e3  # "unknown": wide enough to pull on nothing that is measured, finite so that nothing is singular
FLAT_RAD = 1.0
_ROUNDS = 100
# Wide: a tenth of the rows a few sigma off are what the kinematics lack, which must raise s^2, and no outliers.
_OUTLIER_WIDTH = 30.0
_OUTLIER_SHARE = (1e-3, 0.4)
_PRIOR_SCALE = (0.1, 300.0)
_AS_BUILT_SCALE = 30.0
_DAMPING = (1e-9, 1e-4, 1e9)  # least, first after a refused step, greatest
_SETTLED = 1e-3
_LEAST_EXCESS = 1e-12


@dataclass(frozen=True)
class Fit:
    """Result of `refine` and `posterior`.

    Attributes:
        x: (p,) parameters; with k additions (p + k,), their coefficients last.
        covariance: of `x`, posterior of the model linearised there, the uncertainty of an estimated prior scale in it;
            zero rows for what was held.
        excess_variance: s^2, mm^2 per axis.
        prior_scale: what the build tolerances were multiplied by.
        weight: (m,) probability that a sample is no outlier.
        cost: negative log evidence at the solution; lower is better on the same samples.
        settled: False if the iteration ended before it came to rest.
        rounds: iterations that it took, 0 where a method does not count them.
    """

    x: Floats
    covariance: Floats
    excess_variance: float
    prior_scale: float
    weight: Floats
    cost: float
    settled: bool
    rounds: int = 0


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
    free: Flags | None = None,
    prior: Prior = "recalibration",
    excess_variance: float | None = None,
    additions: Additions | None = None,
) -> Fit:
    """Find the maximum of the posterior near `start`.

    Args:
        chain: kinematics.
        samples: m rows.
        start: (p,) parameters; with k additions also (p + k,), else their coefficients start at zero.
        free: which of them move; all by default, and all additions where it has p entries.
        prior: trust the build tolerances, or estimate one factor on all of them.
        excess_variance: hold s^2 at this value instead of estimating it.
        additions: coefficients to estimate along, with columns for the m rows.

    Raises:
        CalibrationError: the numbers left the range of floating point.
        ValueError: additions for another number of rows.
    """
    return _fit(_Problem(chain, samples, free, additions), start, prior, excess_variance, moves=True)


def posterior(chain: Chain, samples: Samples, x: Floats, *, prior: Prior = "recalibration") -> Fit:
    """Noise, outliers, covariance and cost as they are at `x` itself, for methods that search by other means.

    Arguments and errors as `refine`.
    """
    return _fit(_Problem(chain, samples, None, None), x, prior, None, moves=False)


def information(
    chain: Chain,
    samples: Samples,
    x: Floats,
    *,
    excess_variance: float,
    weight: Floats | None = None,
    additions: Additions | None = None,
) -> Floats:
    """J' V^-1 J: what the samples alone, without a prior, say of the parameters (p,) or (p + k,).

    Args:
        chain, samples, x, additions: as `refine`.
        excess_variance: s^2, mm^2 per axis.
        weight: (m,) probability that a sample is no outlier; 1 by default.
    """
    problem = _Problem(chain, samples, None, additions)
    state = problem.at(problem.extended(x))
    given = np.ones(len(samples)) if weight is None else weight[problem.order]
    whitened = problem.whitening(state, problem.marginals(state, excess_variance), given).whiten(state.jacobian)
    matrix: Floats = whitened.T @ whitened
    return matrix


@dataclass(frozen=True)
class WhitenedRows:
    """m samples about a fit, in units of their noise; rows are sample-major, x, y, z of the first sample first.

    Attributes:
        error_mm: (m, 3) measured minus modelled.
        error: (3 m,) the same in units of the noise.
        jacobian: (3 m, q) by parameters and coefficients, in prior sigmas of each.
        value: (q,) where the fit has these, in prior sigmas.
        precision_root: (q,) one over the prior sigmas.
        joint_jacobian: (m, 3, joints) by reading, station's frame, mm per deg or mm.
        parameter_jacobian: (m, 3, p) by parameter, mm per mm or rad.
        whiten: (m, 3, k) displacements in mm -> (3 m, k).
    """

    error_mm: Floats
    error: Floats
    jacobian: Floats
    value: Floats
    precision_root: Floats
    joint_jacobian: Floats
    parameter_jacobian: Floats
    whiten: Callable[[Floats], Floats]


def whitened_rows(
    chain: Chain,
    samples: Samples,
    fit: Fit,
    *,
    excess_variance: float,
    weight: Floats,
    additions: Additions | None = None,
) -> WhitenedRows:
    """The linear model about a fit, its noise whitened.

    Args:
        chain, samples, fit, additions: the fit and what it was of.
        excess_variance: s^2, mm^2 per axis.
        weight: (m,) probability that a sample is no outlier.
    """
    problem = _Problem(chain, samples, None, additions)
    state = problem.at(fit.x)
    of_rows = problem.marginals(state, excess_variance)
    own = weight[problem.order]
    whitening = problem.whitening(state, of_rows, own)
    rows = (3 * problem.order[:, None] + np.arange(3)).ravel()

    def back(whitened: Floats) -> Floats:
        out = np.empty_like(whitened)
        out[rows] = whitened
        return out

    def of_samples(values: Floats) -> Floats:
        out = np.empty_like(values)
        out[problem.order] = values
        return out

    root = problem.precision(fit.prior_scale) ** 0.5
    return WhitenedRows(
        of_samples(state.error),
        back(whitening.whiten(state.error))[:, 0],
        back(whitening.whiten(state.jacobian)) / root,
        fit.x * root,
        root,
        of_samples(state.by_joint),
        of_samples(state.jacobian[:, :, : len(chain)]),
        lambda moved_mm: back(whitening.whiten(moved_mm[problem.order])),
    )


@dataclass(frozen=True)
class _State:
    x: Floats
    error: Floats  # (m, 3) measured minus modelled
    jacobian: Floats  # (m, 3, p + k)
    by_joint: Floats


@dataclass(frozen=True)
class _Noise:
    """What is estimated beside the parameters."""

    excess: float
    share: float
    scale: float  # of the prior


class _Problem:
    """Chain and samples, rows in the order of their standstills."""

    def __init__(self, chain: Chain, samples: Samples, free: Flags | None, additions: Additions | None) -> None:
        if additions is not None and len(additions.column) != len(samples):
            raise ValueError(f"additions have {len(additions.column)} rows where there are {len(samples)} samples")
        standstill = np.arange(len(samples)) if samples.standstill is None else samples.standstill
        self.order = np.argsort(standstill, kind="stable")
        following = np.flatnonzero(np.diff(standstill[self.order])) + 1
        self._start = np.concatenate([[0], following, [len(samples)]]).astype(np.intp)
        self.chain = chain
        self._added = additions.select(self.order) if additions is not None else None
        self._data = samples.data.select(self.order)
        self._position_mm = samples.position_mm[self.order]
        self._station = samples.station_covariance[self.order]
        self._rates = samples.rates[self.order] * chain.rig.station.timing_sigma_s
        self._shared = samples.shared_variance(chain.rig)
        self._variance = self._shared + samples.own_variance(chain.rig)[self.order]
        self._linearise = Lineariser(chain)
        added = np.zeros(0) if additions is None else additions.prior_sigma
        self._added_precision = 1.0 / added**2
        given = np.ones(0, dtype=bool) if free is None else free
        self.free = np.concatenate([given, np.ones(len(chain) + len(added) - len(given), dtype=bool)])
        self.tolerated = self.free & np.concatenate([np.isfinite(chain.prior_sigma), np.zeros(len(added), dtype=bool)])

    def extended(self, x: Floats) -> Floats:
        """`x` with the coefficients that it lacks at zero."""
        return np.concatenate([x, np.zeros(len(self.free) - len(x))])

    def precision(self, scale: float) -> Floats:
        """Of the priors of all that is free; tolerances of effects are no build tolerances and keep their scale."""
        precision: Floats = np.concatenate([prior_precision(self.chain, scale), self._added_precision])[self.free]
        return precision

    def at(self, x: Floats) -> _State:
        p = len(self.chain)
        data, added = self._data, self._added
        if added is not None:
            data = ChainData(data.readings + added.change(x[p:], data.readings.shape[1]), data.prism, data.setup)
        position, jacobian, by_joint = self._linearise(x[:p], data)
        if added is not None:
            position = position + added.shifted_mm(x[p:])
            jacobian = np.concatenate([jacobian, added.moved_mm(by_joint)], axis=2)
        return _State(x, self._position_mm - position, jacobian, by_joint)

    def marginals(self, state: _State, excess: float) -> Marginals:
        velocity = (state.by_joint @ self._rates[:, :, None])[:, :, 0]
        return marginals(self._station, velocity, state.by_joint, self._variance, excess, state.error)

    def whitening(self, state: _State, of_rows: Marginals, weight: Floats) -> Whitening:
        return factorise(self._start, of_rows, state.by_joint, self._shared, weight)

    def original(self, weight: Floats) -> Floats:
        """Values (m,) in the order of the samples."""
        out = np.empty_like(weight)
        out[self.order] = weight
        return out


class _View:
    """The posterior around a state: outliers weighted, rows whitened, the quadratic model in what is free."""

    def __init__(self, problem: _Problem, state: _State, noise: _Noise) -> None:
        self.problem, self.state, self.noise = problem, state, noise
        self.of_rows = problem.marginals(state, noise.excess)
        self.weight = _inlier_probability(self.of_rows.square, noise.share)
        self.whitening = problem.whitening(state, self.of_rows, self.weight)
        free = problem.free
        self.jacobian = self.whitening.whiten(state.jacobian if free.all() else state.jacobian[:, :, free])
        self.error = self.whitening.whiten(state.error)[:, 0]
        self.precision = problem.precision(noise.scale)
        self.normal = gram(self.jacobian) + np.diag(self.precision)
        _require_finite(self.normal)
        self.gradient = self.jacobian.T @ self.error - self.precision * state.x[free]

    @cached_property
    def covariance(self) -> Floats:
        return _inverse(self.normal)

    def squares(self, at: _State) -> float:
        """Weighted squares plus the prior's at another state, noise and weights as they are here."""
        whitened = self.whitening.whiten(at.error)
        return float((whitened**2).sum() + self.precision @ at.x[self.problem.free] ** 2)

    def excess(self, step: Floats) -> float:
        """s^2 after a Fisher scoring step of the restricted likelihood, the parameters moved by `step` meanwhile.

        It equates e' V^-1 (dV/ds^2) V^-1 e with tr P (dV/ds^2), P = V^-1 - V^-1 J C J' V^-1.
        """
        jacobian = self.whitening.finish(self.jacobian)
        error = self.whitening.finish((self.error - self.jacobian @ step)[:, None])
        total, curvature = self.whitening.trace
        left = total - float(np.sum(gram(jacobian) * self.covariance))
        if left <= 0.0:
            return self.noise.excess
        change = (float((error**2).sum()) - left) / (curvature * left / total)
        # Downwards a single step may leave the range in which the quadratic model holds.
        return max(self.noise.excess + change, 0.1 * self.noise.excess, _LEAST_EXCESS)

    @property
    def determined(self) -> float:
        """gamma: how many of the parameters with a build tolerance the data determine."""
        inside = self.problem.tolerated[self.problem.free]
        return float(np.sum(1.0 - np.diag(self.covariance)[inside] * self.precision[inside]))

    def prior_scale(self, x: Floats) -> float:
        """MacKay: scale^2 = sum of (x / sigma)^2 over the number of parameters that the data determine."""
        inside = self.problem.tolerated
        precision = self.precision[inside[self.problem.free]]
        squares = float(precision @ x[inside] ** 2) * self.noise.scale**2
        return float(np.clip(math.sqrt(squares / max(self.determined, 1.0)), *_PRIOR_SCALE))

    @property
    def covariance_of_unsure_scale(self) -> Floats:
        """The covariance where the prior's scale is estimated, and so uncertain itself.

        Given squares of gamma determined parameters, scale^2 is inverse chi-square distributed: gamma / (gamma - 2)
        times the estimate in the mean. What the data do not see is that much less certain.
        """
        inside = self.problem.tolerated[self.problem.free]
        mean = 1.0 + 2.0 / max(self.determined - 2.0, 1.0)
        return _inverse(self.normal - np.diag(np.where(inside, self.precision * (1.0 - 1.0 / mean), 0.0)))

    def cost(self) -> float:
        """Negative log evidence (Laplace), up to a constant: fits of one data set from different starts compare by it.

        Every row's mixture by itself, plus what the correlation among the inliers of standstills adds. Far out an
        outlier is as likely as by Cauchy's distribution: how far a gross one is tells nothing of the noise of others.
        """
        rows, share = self.of_rows, self.noise.share
        inlier = math.log(1.0 - share) - 0.5 * (rows.square + rows.log_det)
        outlier = math.log(share) - 3.0 * math.log(_OUTLIER_WIDTH)
        tail = 2.0 * np.log1p(rows.square / _OUTLIER_WIDTH**2)
        likelihood = np.logaddexp(inlier, outlier - tail - 0.5 * rows.log_det).sum()
        together = float(self.error @ self.error) + self.whitening.log_det
        correlation = 0.5 * (float(self.weight @ rows.square) + float(rows.log_det.sum()) - together)
        prior = 0.5 * (np.log(self.precision) - self.precision * self.state.x[self.problem.free] ** 2).sum()
        scale = 1.0 / np.sqrt(np.diag(self.normal))
        determinant = np.linalg.slogdet(self.normal * scale[:, None] * scale)[1] - 2.0 * np.log(scale).sum()
        return -float(likelihood + correlation + prior - 0.5 * determinant)


def _fit(problem: _Problem, start: Floats, prior: Prior, excess_variance: float | None, *, moves: bool) -> Fit:
    """Alternate between the parameters (if it `moves`) and what is estimated beside them until all are at rest."""
    state = problem.at(problem.extended(start))
    _require_finite(state.error)
    robust = float(np.median(np.linalg.norm(state.error, axis=1))) / 1.54  # median of a 3-D normal's norm
    excess = max(robust**2, _LEAST_EXCESS) if excess_variance is None else excess_variance
    noise = _Noise(excess, 0.05, _AS_BUILT_SCALE if prior == "as-built" else 1.0)
    damping, settled, rounds, weight = 0.0, False, 0, np.ones(len(problem.order))
    while not settled and rounds < _ROUNDS:
        rounds += 1
        view = _View(problem, state, noise)
        step, size, moved = np.zeros(int(problem.free.sum())), 0.0, state
        if moves:
            moved, damping, step, size = _step(view, damping)
        change = float(np.abs(view.weight - weight).max()) / 10.0
        weight = view.weight
        excess, scale = noise.excess, noise.scale
        if excess_variance is None:
            excess = view.excess(step)
            known = float(np.trace(view.of_rows.block, axis1=1, axis2=2).mean()) / 3.0
            change = max(change, abs(excess - noise.excess) / known)
        if prior == "as-built" and problem.tolerated.any():
            scale = view.prior_scale(moved.x)
            change = max(change, abs(math.log(scale / noise.scale)))
        noise = _Noise(excess, float(np.clip(1.0 - weight.mean(), *_OUTLIER_SHARE)), scale)
        state = moved
        settled = max(size, change) < _SETTLED
    view = _View(problem, state, noise)
    covariance = np.zeros((len(state.x), len(state.x)))
    unsure = prior == "as-built" and problem.tolerated.any()
    covariance[np.ix_(problem.free, problem.free)] = view.covariance_of_unsure_scale if unsure else view.covariance
    weight = problem.original(view.weight)
    return Fit(state.x, covariance, noise.excess, noise.scale, weight, view.cost(), settled, rounds)


def _require_finite(values: Floats) -> None:
    if not np.isfinite(values).all():
        raise CalibrationError("identification: the fit left the range of numbers; check units of the observations")


def _inlier_probability(square: Floats, share: float) -> Floats:
    odds = math.log((1.0 - share) / share) + 3.0 * math.log(_OUTLIER_WIDTH)
    probability: Floats = expit(odds - 0.5 * square * (1.0 - _OUTLIER_WIDTH**-2))
    return probability


def _factor(matrix: Floats) -> tuple[Floats, tuple[Floats, bool]]:
    """Scale that gives the matrix a unit diagonal, and the Cholesky factor of that."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return scale, cho_factor(matrix * scale[:, None] * scale, lower=True)


def _inverse(matrix: Floats) -> Floats:
    scale, factor = _factor(matrix)
    inverse: Floats = cho_solve(factor, np.eye(len(matrix))) * scale[:, None] * scale
    return inverse


def _step(view: _View, damping: float) -> tuple[_State, float, Floats, float]:
    """A damped step that does not raise the weighted squares: new state, next damping, the step, its size in sigma."""
    state, free = view.state, view.problem.free
    here = float(view.error @ view.error + view.precision @ state.x[free] ** 2)
    while damping < _DAMPING[2]:
        try:
            scale, factor = _factor(view.normal + damping * np.diag(np.diag(view.normal)))
        except LinAlgError:
            damping = max(10.0 * damping, _DAMPING[1])
            continue
        step = scale * cho_solve(factor, scale * view.gradient)
        x = state.x.copy()
        x[free] += step
        moved = view.problem.at(x)
        if view.squares(moved) <= here * (1.0 + 1e-12):
            size = math.sqrt(max(0.0, float(step @ view.normal @ step) / len(step)))
            return moved, damping / 10.0 if damping > _DAMPING[0] else 0.0, step, size
        damping = max(10.0 * damping, _DAMPING[1])
    return state, 0.0, np.zeros(len(view.gradient)), 0.0
