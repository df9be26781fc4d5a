"""Gauss-Newton fit with whitened residuals, build-tolerance priors, downweighted outliers and estimated noise.

The model of an observation: with probability 1 - epsilon its error is normal with the covariance
Sigma_station + J_q Sigma_q J_q' + timing + s^2 I, else thirty times as wide. Inliers of one standstill are correlated,
as they share errors of its readings (`whitening`). The excess variance s^2 is estimated from the scatter of the data,
so that small sigma columns never make the fit follow a few rows when errors of the kinematic model dominate. It is
found by restricted maximum likelihood (the parameters' degrees of freedom do not count as noise), epsilon by
expectation-maximisation, and the prior's scale, if requested, by MacKay's evidence update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, lapack
from scipy.special import expit

from calibration.effects.columns import EffectColumns
from calibration.errors import CalibrationError
from calibration.identification.linear_model import Flags, Linearised, LinearModel
from calibration.identification.samples import Samples
from calibration.kinematics.chain import Chain
from calibration.numerics.matrices import gram, inverse_by
from calibration.observations import Floats

Prior = Literal["recalibration", "as-built"]

_ROUNDS = 100
# Wide: if a tenth of the rows is off by a few sigma, the kinematic model is wrong there; that must raise s^2 instead.
_OUTLIER_WIDTH = 30.0
_OUTLIER_SHARE = (1e-3, 0.4)
_PRIOR_SCALE = (0.1, 300.0)
_AS_BUILT_SCALE = 30.0
_DAMPING = (1e-9, 1e-4, 1e9)  # least, first after a refused step, greatest
_CONVERGED = 1e-3
_SAME_NOISE = 0.01  # relative change of noise or prior that triggers recomputing quantities that depend on them weakly
_LEAST_EXCESS = 1e-12


@dataclass(frozen=True)
class Fit:
    """Result of `refine` and `posterior`.

    Attributes:
        x: (p,) parameters; with k additions (p + k,), their coefficients last.
        covariance: posterior covariance of `x` in the model linearised there, including the uncertainty of an estimated
            prior scale; zero rows and columns for parameters that were held.
        excess_variance: s^2, mm^2 per axis.
        prior_scale: factor on the build tolerances.
        weight: (m,) probability that a sample is no outlier.
        cost: negative log evidence at the solution; lower is better on the same samples.
        converged: whether the iteration converged.
        rounds: number of iterations, 0 if a method does not count them.
    """

    x: Floats
    covariance: Floats
    excess_variance: float
    prior_scale: float
    weight: Floats
    cost: float
    converged: bool
    rounds: int = 0


def refine(
    chain: Chain,
    samples: Samples,
    start: Floats,
    *,
    free: Flags | None = None,
    prior: Prior = "recalibration",
    excess_variance: float | None = None,
    additions: EffectColumns | None = None,
    like: Fit | None = None,
) -> Fit:
    """Find the maximum of the posterior near `start`.

    Args:
        chain: kinematics.
        samples: m rows.
        start: (p,) parameters; with k additions also (p + k,), else their coefficients start at zero.
        free: (p,) or (p + k,) mask of what to fit; all by default, and all coefficients if it has p entries.
        prior: trust the build tolerances, or estimate one factor on all of them.
        excess_variance: hold s^2 at this value instead of estimating it.
        additions: k coefficients of effects to estimate in the same fit, with columns for the m rows.
        like: a fit of nearly the same model that provides the initial noise, which is otherwise estimated at `start`.

    Raises:
        CalibrationError: the numbers left the range of floating point.
        ValueError: the number of rows of the additions differs from m.
    """
    return _fit(LinearModel(chain, samples, free, additions), start, prior, excess_variance, moves=True, like=like)


def posterior(chain: Chain, samples: Samples, x: Floats, *, prior: Prior = "recalibration") -> Fit:
    """Estimate noise, outliers, covariance and cost at a fixed `x`, for parameters found by other methods.

    Args:
        chain: kinematics.
        samples: m rows.
        x: (p,) parameters.
        prior: as in `refine`.

    Raises:
        CalibrationError: as `refine`.
    """
    return _fit(LinearModel(chain, samples), x, prior, None, moves=False)


@dataclass(frozen=True)
class WhitenedRows:
    """m samples linearised about a fit, in units of their noise; rows are x, y, z of the first sample, then the second.

    Attributes:
        error_mm: (m, 3) measured minus modelled.
        error: (3 m,) the same in units of the noise.
        jacobian: (3 m, q) derivatives by parameters and coefficients, each in its prior sigmas.
        value: (q,) fitted values of these, in prior sigmas.
        precision_root: (q,) 1 / sigma of the priors.
        joint_jacobian: (m, 3, joints) derivatives by readings in the station's frame, mm per deg or mm.
        parameter_jacobian: (m, 3, p) derivatives by parameters, mm per mm or rad.
        whiten: function that whitens displacements (m, 3, k) in mm to (3 m, k).
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
    additions: EffectColumns | None = None,
) -> WhitenedRows:
    """Linearise about a fit and whiten the noise.

    Args:
        chain: kinematics.
        samples: m rows.
        fit: result of fitting `chain` to `samples`.
        additions: k coefficients of effects in that fit, with columns for the m rows.
    """
    model = LinearModel(chain, samples, additions=additions)
    state = model.at(fit.x)
    whitening = model.whitening(state, model.marginals(state, fit.excess_variance), fit.weight[model.order])

    def whitened(values: Floats) -> Floats:
        rows = whitening.whiten(values).reshape(len(samples), 3, -1)
        return model.by_sample(rows).reshape(3 * len(samples), -1)

    root = model.precision(fit.prior_scale) ** 0.5
    return WhitenedRows(
        error_mm=model.by_sample(state.error),
        error=whitened(state.error)[:, 0],
        jacobian=whitened(state.jacobian) / root,
        value=fit.x * root,
        precision_root=root,
        joint_jacobian=model.by_sample(state.by_joint),
        parameter_jacobian=model.by_sample(state.jacobian[:, :, : len(chain)].copy()),
        whiten=lambda moved_mm: whitened(model.by_row(moved_mm)),
    )


@dataclass(frozen=True)
class _Noise:
    """Quantities estimated in addition to the parameters."""

    excess: float
    share: float
    scale: float  # of the prior


class _Posterior:
    """Quadratic model of the posterior about a state, with weighted outliers and whitened rows."""

    def __init__(self, model: LinearModel, state: Linearised, noise: _Noise) -> None:
        self.model, self.state, self.noise = model, state, noise
        self.of_rows = model.marginals(state, noise.excess)
        self.weight = _inlier_probability(self.of_rows.square, noise.share)
        self.whitening = model.whitening(state, self.of_rows, self.weight)
        free = model.free
        self.jacobian = self.whitening.whiten(state.jacobian if free.all() else state.jacobian[:, :, free])
        self.error = self.whitening.whiten(state.error)[:, 0]
        self.precision = model.precision(noise.scale)
        self.normal = gram(self.jacobian)
        self.normal[np.diag_indices_from(self.normal)] += self.precision
        _require_finite(self.normal)
        self.gradient = self.jacobian.T @ self.error - self.precision * state.x[free]

    @cached_property
    def factor(self) -> _Factor:
        """Factor of the normal equations; LinAlgError if they are not positive definite."""
        return _Factor(self.normal)

    @cached_property
    def covariance(self) -> Floats:
        return self.factor.inverse()

    def squares(self, at: Linearised) -> float:
        """Return the weighted squares plus the prior's at another state, with the noise and weights of this one."""
        whitened = self.whitening.whiten(at.error)
        return float((whitened**2).sum() + self.precision @ at.x[self.model.free] ** 2)

    @property
    def fitted_share(self) -> float:
        """Share of tr V^-1 (dV/ds^2) that the parameters fit: tr V^-1 J C J' V^-1 (dV/ds^2) divided by that."""
        jacobian = self.whitening.finish(self.jacobian)
        return float(np.vdot(gram(jacobian), self.covariance)) / self.whitening.trace[0]

    def excess(self, step: Floats, fitted_share: float) -> float:
        """Return s^2 after a Fisher scoring step of the restricted likelihood, with the parameters moved by `step`.

        It equates e' V^-1 (dV/ds^2) V^-1 e with tr P (dV/ds^2), P = V^-1 - V^-1 J C J' V^-1.
        """
        error = self.whitening.finish((self.error - self.jacobian @ step)[:, None])
        total, curvature = self.whitening.trace
        left = total * (1.0 - fitted_share)
        if left <= 0.0:
            return self.noise.excess
        change = (float((error**2).sum()) - left) / (curvature * left / total)
        # A large step downwards may leave the range in which the quadratic model holds.
        return max(self.noise.excess + change, 0.1 * self.noise.excess, _LEAST_EXCESS)

    @property
    def determined(self) -> float:
        """gamma: effective number of parameters with a build tolerance that the data determine."""
        inside = self.model.tolerated[self.model.free]
        return float(np.sum(1.0 - np.diag(self.covariance)[inside] * self.precision[inside]))

    def prior_scale(self, x: Floats) -> float:
        """Return MacKay's estimate: scale^2 = sum of (x / sigma)^2 divided by the number of determined parameters."""
        inside = self.model.tolerated
        precision = self.precision[inside[self.model.free]]
        squares = float(precision @ x[inside] ** 2) * self.noise.scale**2
        return float(np.clip(math.sqrt(squares / max(self.determined, 1.0)), *_PRIOR_SCALE))

    @property
    def covariance_of_unsure_scale(self) -> Floats:
        """Covariance if the prior's scale is estimated and therefore uncertain.

        Given the squares of gamma determined parameters, scale^2 has an inverse chi-square distribution whose mean is
        gamma / (gamma - 2) times the estimate. The prior variance of what the data do not see grows by that factor.
        """
        inside = self.model.tolerated[self.model.free]
        mean = 1.0 + 2.0 / max(self.determined - 2.0, 1.0)
        return _Factor(self.normal - np.diag(np.where(inside, self.precision * (1.0 - 1.0 / mean), 0.0))).inverse()

    def cost(self) -> float:
        """Return the negative log evidence (Laplace), up to a constant, to compare fits of one data set.

        It is the sum over the mixtures of all rows, plus the contribution of correlation among inliers of standstills.
        Outliers have the tails of a Cauchy distribution, as the size of a gross outlier says nothing about the noise.
        """
        rows, share = self.of_rows, self.noise.share
        inlier = math.log(1.0 - share) - 0.5 * (rows.square + rows.log_det)
        outlier = math.log(share) - 3.0 * math.log(_OUTLIER_WIDTH)
        tail = 2.0 * np.log1p(rows.square / _OUTLIER_WIDTH**2)
        likelihood = np.logaddexp(inlier, outlier - tail - 0.5 * rows.log_det).sum()
        together = float(self.error @ self.error) + self.whitening.log_det
        correlation = 0.5 * (float(self.weight @ rows.square) + float(rows.log_det.sum()) - together)
        prior = 0.5 * (np.log(self.precision) - self.precision * self.state.x[self.model.free] ** 2).sum()
        return -float(likelihood + correlation + prior - 0.5 * self.factor.log_det)


def _fit(
    model: LinearModel,
    start: Floats,
    prior: Prior,
    excess_variance: float | None,
    *,
    moves: bool,
    like: Fit | None = None,
) -> Fit:
    """Alternate between the parameters (if `moves`) and noise, outliers and prior scale until all converge."""
    state = model.at(model.extended(start))
    _require_finite(state.error)
    noise = _first_noise(state, prior) if like is None else _noise_of(like)
    noise = noise if excess_variance is None else replace(noise, excess=excess_variance)
    damping, converged, rounds, weight = 0.0, False, 0, np.ones(len(model.order))
    fitted_share, computed_at = 0.0, np.zeros(2)
    while not converged and rounds < _ROUNDS:
        rounds += 1
        view = _Posterior(model, state, noise)
        step, size, moved = np.zeros(int(model.free.sum())), 0.0, state
        if moves:
            moved, damping, step, size = _step(view, damping)
        change = float(np.abs(view.weight - weight).max()) / 10.0
        weight = view.weight
        excess, scale = noise.excess, noise.scale
        if excess_variance is None:
            at = np.array([view.whitening.trace[0], scale])
            if (np.abs(at - computed_at) > _SAME_NOISE * at).any():
                fitted_share, computed_at = view.fitted_share, at
            excess = view.excess(step, fitted_share)
            known = float(np.median(np.trace(view.of_rows.block, axis1=1, axis2=2))) / 3.0
            change = max(change, abs(excess - noise.excess) / known)
        if prior == "as-built" and model.tolerated.any():
            scale = view.prior_scale(moved.x)
            change = max(change, abs(math.log(scale / noise.scale)))
        noise = _Noise(excess, float(np.clip(1.0 - weight.mean(), *_OUTLIER_SHARE)), scale)
        state = moved
        converged = max(size, change) < _CONVERGED
    view = _Posterior(model, state, noise)
    covariance = np.zeros((len(state.x), len(state.x)))
    unsure = prior == "as-built" and model.tolerated.any()
    covariance[np.ix_(model.free, model.free)] = view.covariance_of_unsure_scale if unsure else view.covariance
    weight = model.by_sample(view.weight)
    return Fit(state.x, covariance, noise.excess, noise.scale, weight, view.cost(), converged, rounds)


def _first_noise(state: Linearised, prior: Prior) -> _Noise:
    """Return a robust first estimate of the noise from the errors at a state."""
    robust = float(np.median(np.linalg.norm(state.error, axis=1))) / 1.54  # median of a 3-D normal's norm
    return _Noise(max(robust**2, _LEAST_EXCESS), 0.05, _AS_BUILT_SCALE if prior == "as-built" else 1.0)


def _noise_of(fit: Fit) -> _Noise:
    """Return the noise of a fit."""
    share = float(np.clip(1.0 - fit.weight.mean(), *_OUTLIER_SHARE))
    return _Noise(max(fit.excess_variance, _LEAST_EXCESS), share, fit.prior_scale)


def _require_finite(values: Floats) -> None:
    if not np.isfinite(values).all():
        raise CalibrationError("identification: the fit left the range of floating point; check units of the data")


def _inlier_probability(square: Floats, share: float) -> Floats:
    odds = math.log((1.0 - share) / share) + 3.0 * math.log(_OUTLIER_WIDTH)
    probability: Floats = expit(odds - 0.5 * square * (1.0 - _OUTLIER_WIDTH**-2))
    return probability


def damped_step(normal: Floats, gradient: Floats, damping: float) -> Floats:
    """Return the Levenberg-Marquardt step (q,).

    Args:
        normal: (q, q) matrix of the normal equations.
        gradient: (q,) their right-hand side.
        damping: share of the diagonal that is added to it.

    Raises:
        LinAlgError: the damped matrix is not positive definite.
    """
    return _Factor(normal + damping * np.diag(np.diag(normal))).solve(gradient)


class _Factor:
    """Cholesky factor of a matrix (q, q) scaled to a unit diagonal; LinAlgError if it is not positive definite."""

    def __init__(self, matrix: Floats) -> None:
        self._scale = 1.0 / np.sqrt(np.diag(matrix))
        scaled = matrix * self._scale[:, None]
        scaled *= self._scale
        # As the matrix is symmetric, LAPACK can use its transpose without a copy.
        self._lower, failed = lapack.dpotrf(scaled.T, lower=1, overwrite_a=1)
        if failed:
            raise LinAlgError("the normal equations are not positive definite")

    @property
    def log_det(self) -> float:
        """Logarithm of the matrix's determinant."""
        return 2.0 * float(np.log(np.diag(self._lower)).sum() - np.log(self._scale).sum())

    def solve(self, right: Floats) -> Floats:
        """Solve the linear system for a right-hand side (q,)."""
        solved: Floats = self._scale * cho_solve((self._lower, True), self._scale * right)
        return solved

    def inverse(self) -> Floats:
        """Return the inverse of the matrix."""
        whole = inverse_by(self._lower)
        whole *= self._scale[:, None]
        whole *= self._scale
        return whole


def _step(view: _Posterior, damping: float) -> tuple[Linearised, float, Floats, float]:
    """Take a damped step that does not raise the weighted squares.

    Returns:
        The new state, the next damping, the step, and its RMS size in sigma.
    """
    state, free = view.state, view.model.free
    here = float(view.error @ view.error + view.precision @ state.x[free] ** 2)
    while damping < _DAMPING[2]:
        try:
            undamped = damping == 0.0
            step = view.factor.solve(view.gradient) if undamped else damped_step(view.normal, view.gradient, damping)
        except LinAlgError:
            damping = max(10.0 * damping, _DAMPING[1])
            continue
        x = state.x.copy()
        x[free] += step
        moved = view.model.at(x)
        if view.squares(moved) <= here * (1.0 + 1e-12):
            size = math.sqrt(max(0.0, float(step @ view.normal @ step) / len(step)))
            return moved, damping / 10.0 if damping > _DAMPING[0] else 0.0, step, size
        damping = max(10.0 * damping, _DAMPING[1])
    return state, 0.0, np.zeros(len(view.gradient)), 0.0
