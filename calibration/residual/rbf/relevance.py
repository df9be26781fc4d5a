"""Relevance of each input to a Gaussian kernel: one width per dimension, by the evidence of a Gaussian process.

Rasmussen & Williams 2006, section 5.1 (automatic relevance determination, Eqs. 5.8 and 5.9), with one kernel for all
outputs. An exponential prior on the relevances excludes inputs that only explain noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.optimize import minimize

from calibration.observations import Floats

WIDEST = 30.0  # in standard deviations of the input, which then has almost no influence within the data
_NARROWEST = 0.15
_STARTS = (0.3, 1.0, 2.0)  # initial relevances, as the evidence has several maxima
_FIRST_ROWS = 300  # on which the starts are compared
_FIRST_STEPS, _STEPS = 15, 25
_CONVERGED = 1e-5
_PRIOR = 1.0  # of each relevance: density exp(-relevance)
_SIGNAL = (1e-2, 20.0)  # variances, in mean squares of the outputs
_NOISE = (1e-4, 2.0)
_CONSTANT = 1e-6  # of inputs of standard deviation 1
_JITTER = 1e-8


@dataclass(frozen=True)
class Relevance:
    """Result of `relevance`.

    Attributes:
        widths: (d,) width of each input, in standard deviations; infinite if the input is constant.
        signal, noise: variances, relative to the mean square of the outputs.
    """

    widths: Floats
    signal: float
    noise: float

    @property
    def ridge(self) -> float:
        """Ratio of noise to signal."""
        return self.noise / self.signal


def relevance(x: Floats, y: Floats, start: Relevance | None = None) -> Relevance:
    """Find the widths with the highest evidence; each of about 25 steps costs n^3, so pass a few hundred rows.

    Args:
        x: (n, d) standardised inputs, rows in random order.
        y: (n, k) outputs with a mean of about zero.
        start: result for similar rows to start from; by default several starts are compared.
    """
    varying = np.ptp(x, axis=0) > _CONSTANT
    size = float(np.sqrt((y**2).mean()))
    if not varying.any() or size == 0.0:
        return Relevance(np.where(varying, WIDEST, np.inf), 1.0, 1.0)
    count = int(varying.sum())
    bounds = [(-np.log(WIDEST), -np.log(_NARROWEST))] * count
    bounds += [(np.log(low), np.log(high)) for low, high in (_SIGNAL, _NOISE)]
    inputs, outputs = x[:, varying], y / size
    if start is not None:
        best = np.log([*(1.0 / np.minimum(start.widths[varying], WIDEST)), start.signal, start.noise])
    else:
        few = _Evidence(inputs[:_FIRST_ROWS], outputs[:_FIRST_ROWS])
        starts = [np.log([*[relevance] * count, 1.0, 0.3]) for relevance in _STARTS]
        best = min((_climb(few, at, bounds, _FIRST_STEPS) for at in starts), key=lambda found: found[0])[1]
    _, best = _climb(_Evidence(inputs, outputs), best, bounds, _STEPS)
    widths = np.full(x.shape[1], np.inf)
    widths[varying] = np.exp(-best[:count])
    return Relevance(widths, float(np.exp(best[-2])), float(np.exp(best[-1])))


def _climb(evidence: _Evidence, at: Floats, bounds: list[tuple[float, float]], steps: int) -> tuple[float, Floats]:
    found = minimize(
        evidence, at, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps, "ftol": _CONVERGED}
    )
    return float(found.fun), np.asarray(found.x, dtype=np.float64)


class _Evidence:
    """Negative log evidence and its gradient by log relevances, log signal and log noise variance."""

    def __init__(self, x: Floats, y: Floats) -> None:
        self._x, self._y = x, y
        self._diagonal = np.diag_indices(len(x))

    def __call__(self, at: Floats) -> tuple[float, Floats]:
        relevances, signal, noise = np.exp(at[:-2]), float(np.exp(at[-2])), float(np.exp(at[-1]))
        scaled = self._x * relevances
        kernel = signal * gaussian(scaled, scaled)
        covariance = kernel.copy()
        covariance[self._diagonal] += noise + _JITTER
        factor = np.linalg.cholesky(covariance)
        half_log_det = float(np.log(np.diag(factor)).sum())
        # The transpose of a lower triangle is an upper one in LAPACK's column order, so nothing is copied.
        lower = np.asarray(lapack.dpotri(factor.T, overwrite_c=True)[0], dtype=np.float64).T
        inverse = lower + lower.T
        inverse[self._diagonal] *= 0.5
        solved = inverse @ self._y
        value = self._y.shape[1] * half_log_det + 0.5 * float((self._y * solved).sum())
        slope = self._y.shape[1] * inverse - solved @ solved.T  # twice the derivative by the covariance
        by_kernel = slope * kernel
        gradient = np.empty_like(at)
        gradient[:-2] = np.einsum("ij,ij->j", scaled, by_kernel @ scaled) - by_kernel.sum(axis=1) @ scaled**2
        gradient[-2] = 0.5 * by_kernel.sum()
        gradient[-1] = 0.5 * np.trace(slope) * noise
        gradient[:-2] += _PRIOR * relevances
        return value + _PRIOR * float(relevances.sum()), gradient


def half_squares(rows: Floats) -> Floats:
    """Return (n,) half the squared length of each row."""
    return np.asarray(0.5 * np.einsum("ij,ij->i", rows, rows))


def gaussian(a: Floats, b: Floats, half_squares_b: Floats | None = None) -> Floats:
    """Return (n, m) exp(-|a - b|^2 / 2) of all rows of a (n, d) and b (m, d); half squares of b may be given."""
    exponent = a @ b.T
    exponent -= half_squares(a)[:, None]
    exponent -= half_squares(b) if half_squares_b is None else half_squares_b
    np.minimum(exponent, 0.0, out=exponent)
    return np.asarray(np.exp(exponent, out=exponent))


def spread_rows(groups: NDArray[np.str_], count: int, seed: int) -> NDArray[np.intp]:
    """Return row numbers in random order, spread evenly over groups: one of each, then a second of each, and so on.

    Args:
        groups: (n,) label of each row's group.
        count: greatest number of rows to return.
        seed: seed of the random order.
    """
    shuffled = np.random.default_rng(seed).permutation(len(groups))
    _, index, size = np.unique(groups[shuffled], return_inverse=True, return_counts=True)
    by_group = np.argsort(index, kind="stable")
    turn = np.empty(len(groups), dtype=np.intp)
    turn[by_group] = np.arange(len(groups)) - np.repeat(np.cumsum(size) - size, size)
    return shuffled[np.sort(np.argsort(turn, kind="stable")[:count])]
