"""From far off to the neighbourhood of the optimum: damped Gauss-Newton whose outlier limit follows the errors.

The refinement's mixture decides early which rows are outliers. Where the model is metres off that decision is a guess,
and the fit comes to rest on the rows that it guessed for. Here nothing is decided: the limit beyond which a row loses
influence is a multiple of an upper quantile of all errors, wide open at first and closing as the model comes closer
(graduated non-convexity: Blake and Zisserman, "Visual Reconstruction", 1987; the loss is Geman and McClure's).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from calibration.identification.samples import Samples
from calibration.identification.subset import drawn
from calibration.kinematics import Chain
from calibration.observations import Floats

PRIOR_SCALE = {"recalibration": 1.0, "as-built": 30.0}  # of the build tolerances while their scale is not known yet
_ROWS = 300  # enough to lead the way
_ROUNDS = 80
_QUANTILE = 0.7  # of the errors: above half, so that one prism's rows cannot leave the others out
_NORMAL_QUANTILE = 1.914  # of the norm of three standard normal numbers
_LIMIT = 4.0  # standard deviations beyond which a row counts less and less
_DAMPING = (1e-3, 1e-9, 1e9)  # at first, least, most
_SETTLED = 1e-3
_PATIENCE = 3


def approach(
    chain: Chain,
    samples: Samples,
    start: Floats,
    *,
    precision: Floats,
    free: NDArray[np.bool_] | None = None,
    rounds: int = _ROUNDS,
) -> Floats:
    """Parameters (p,) near the optimum that `start` leads to.

    Args:
        chain: kinematics.
        samples: m rows, of which some are used.
        start: (p,) parameters.
        precision: (p,) 1 / sigma^2 of the prior.
        free: (p,) which parameters move; all by default.
        rounds: steps at most.
    """
    free = np.ones(len(chain), dtype=bool) if free is None else free
    rows = drawn(samples.data, samples.position_mm, _ROWS, 0)
    data, position = samples.data.select(rows), samples.position_mm[rows]
    least = math.sqrt(float(np.trace(samples.station_covariance[rows], axis1=1, axis2=2).mean()) / 3.0)
    columns = int(free.sum())
    x, prior = start.copy(), precision[free]
    error = position - chain.positions_mm(x, data)
    scale, damping, quiet = math.inf, _DAMPING[0], 0
    for _ in range(rounds):
        scale = min(scale, _scale(error, least))
        jacobian = chain.linearise(x, data).jacobian[:, :, free]
        weight = (1.0 + _square(error) / (_LIMIT * scale) ** 2) ** -2 / scale**2
        weighted = weight[:, None, None] * jacobian
        normal = jacobian.reshape(-1, columns).T @ weighted.reshape(-1, columns) + np.diag(prior)
        gradient = weighted.reshape(-1, columns).T @ error.ravel() - prior * x[free]
        here = _loss(error, scale) + float(prior @ x[free] ** 2)
        while True:
            there = x.copy()
            there[free] += _damped(normal, gradient, damping)
            moved = position - chain.positions_mm(there, data)
            cost = _loss(moved, scale) + float(prior @ there[free] ** 2)
            if cost <= here or damping >= _DAMPING[2]:
                break
            damping *= 10.0
        if not cost <= here:
            break
        damping = max(damping / 10.0, _DAMPING[1])
        x, error = there, moved
        narrower = _scale(error, least) < scale * (1.0 - _SETTLED)
        quiet = 0 if narrower or here - cost > _SETTLED * here else quiet + 1
        if quiet == _PATIENCE:
            break
    return x


def _square(error: Floats) -> Floats:
    square: Floats = np.einsum("ni,ni->n", error, error)
    return square


def _scale(error: Floats, least: float) -> float:
    """Standard deviation of each coordinate that the quantile of the errors stands for, `least` at least."""
    return max(math.sqrt(float(np.quantile(_square(error), _QUANTILE))) / _NORMAL_QUANTILE, least)


def _loss(error: Floats, scale: float) -> float:
    """Geman and McClure's loss in units of squared sigma; infinite where the numbers left the range."""
    square = _square(error) / scale**2
    loss = float(np.sum(square / (1.0 + square / _LIMIT**2)))
    return loss if math.isfinite(loss) else math.inf


def _damped(normal: Floats, gradient: Floats, damping: float) -> Floats:
    """Levenberg-Marquardt step; none where the matrix cannot be factored."""
    matrix = normal + damping * np.diag(np.diag(normal))
    unit = 1.0 / np.sqrt(np.diag(matrix))
    try:
        step: Floats = unit * cho_solve(cho_factor(matrix * unit[:, None] * unit, lower=True), unit * gradient)
    except LinAlgError:
        return np.zeros_like(gradient)
    return step
