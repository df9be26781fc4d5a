"""Closed-form evidence of a linear normal model from products of its columns, and its maximisation over scales.

For y = C c + noise with normal c, the log evidence and its derivatives by the scale of every block of columns and of
the noise need only C'C, C'y and y'y (Tipping, JMLR 1, 2001). Hundreds of models can therefore be compared at a cost
that does not depend on the number of rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cholesky, lapack
from scipy.optimize import minimize

from calibration.numerics.matrices import inverse_by, inverse_root_by
from calibration.observations import Floats

Integers = NDArray[np.intp]

_LOG_SCALE = (-9.0, 5.0)  # limits of the log scale of a block, relative to plausible sizes
_ITERATIONS = 60
_LEAST_INFORMATION = 0.5  # information about a log scale from the prior knowledge that it is plausible
_MOST_NOISE = 12.0  # limit of the log noise variance, relative to that used for whitening


@dataclass(frozen=True)
class Products:
    """Products of whitened columns.

    Attributes:
        gram: (t, t) products of all columns, in prior sigmas.
        along: (t,) products of the columns with the target.
        squares: sum of squares of the target.
        rows: number of rows.
        least_noise: smallest noise variance, relative to that used for whitening.
    """

    gram: Floats
    along: Floats
    squares: float
    rows: int
    least_noise: float


@dataclass(frozen=True)
class Scales:
    """Scales of maximum evidence.

    Attributes:
        fixed: (f,) indices of the columns whose scales are fixed.
        fixed_sigma: (f,) scales of these columns.
        blocks: block name -> indices of its columns.
        log_scale: block name -> log of the factor on its prior sigmas.
        noise: variance of the noise, relative to that used for whitening.
        log_evidence: log evidence of the model, up to a constant that depends only on the rows.
    """

    fixed: Integers
    fixed_sigma: Floats
    blocks: Mapping[str, Integers]
    log_scale: Mapping[str, float]
    noise: float
    log_evidence: float

    @property
    def index(self) -> Integers:
        """(q,) indices of all columns of the model."""
        return np.concatenate([self.fixed, *self.blocks.values()]).astype(np.intp)

    @property
    def sigma(self) -> Floats:
        """(q,) factors on the prior sigmas of these columns."""
        own = [np.full(len(v), np.exp(self.log_scale[k])) for k, v in self.blocks.items()]
        return np.concatenate([self.fixed_sigma, *own])

    @property
    def weight(self) -> Floats:
        """(q,) factors that scale these columns to coefficients of unit prior variance and residuals of unit noise."""
        weight: Floats = self.sigma / np.sqrt(self.noise)
        return weight


def posterior_factor(gram: Floats) -> Floats:
    """Return the lower Cholesky factor of the posterior precision, from products (q, q) in units of noise and prior."""
    return np.asarray(cholesky(gram + np.eye(len(gram)), lower=True), dtype=np.float64)


def maximise_evidence(
    products: Products,
    fixed: Integers,
    fixed_sigma: Floats,
    blocks: Mapping[str, Integers],
    start: Mapping[str, float],
    noise: float,
    enough: float,
) -> Scales:
    """Return the scales of blocks and noise that maximise the evidence.

    Args:
        products: products of the whitened columns.
        fixed: (f,) indices of the columns whose scales are fixed.
        fixed_sigma: (f,) scales of these columns.
        blocks: block name -> indices of its columns.
        start: block name -> initial log scale.
        noise: initial noise variance.
        enough: tolerance: iterations stop when a step improves the log evidence by less.
    """
    names = list(blocks)
    index = np.concatenate([np.empty(0, dtype=np.intp), *blocks.values()]).astype(np.intp)
    number = np.repeat(np.arange(len(names)), [*map(len, blocks.values())])
    model = FixedAndScaled(products, fixed, fixed_sigma, index)
    least = float(np.log(products.least_noise))
    low = np.append(np.full(len(names), _LOG_SCALE[0]), least)
    high = np.append(np.full(len(names), _LOG_SCALE[1]), _MOST_NOISE)
    theta = np.append([start[name] for name in names], float(np.log(noise))).clip(low, high)
    # Whitening the parameters with the Fisher information makes all directions equal, so that few steps are enough.
    information = model.information(np.exp(theta[number]), float(np.exp(theta[-1])), number)
    information[np.diag_indices_from(information)] += _LEAST_INFORMATION
    turned = np.linalg.inv(np.linalg.cholesky(information)).T

    def negative(z: Floats) -> tuple[float, Floats]:
        at = theta + turned @ z
        inside = at.clip(low, high)
        value, slope, by_noise = model.evidence(np.exp(inside[number]), float(np.exp(inside[-1])))
        slope = np.append(np.bincount(number, slope, minlength=len(names)), by_noise)
        return -value, -(turned.T @ np.where(at == inside, slope, 0.0))

    # SciPy's tolerance is relative to a value of many thousands, but differences of a few units matter.
    begin = np.zeros(len(theta))
    at_begin = negative(begin)

    def from_begin(z: Floats) -> tuple[float, Floats]:
        return negative(z) if z.any() else at_begin

    found = minimize(
        from_begin,
        begin,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": _ITERATIONS, "ftol": enough / max(abs(at_begin[0]), 1.0)},
    )
    best = (theta + turned @ found.x).clip(low, high)
    scale = dict(zip(names, best[:-1].tolist(), strict=True))
    return Scales(fixed, fixed_sigma, dict(blocks), scale, float(np.exp(best[-1])), -float(found.fun))


class FixedAndScaled:
    """Log evidence as a function of the scales of some columns, with the scales of the others fixed.

    In the eigenvectors of their products, the fixed columns are independent of each other at any noise. They are
    eliminated once, and only a matrix of the scaled columns is factored in each evaluation.

    Args:
        products: products of all columns.
        fixed: (f,) indices of the columns whose scales are fixed.
        fixed_sigma: (f,) scales of these columns.
        index: (b,) indices of the columns with variable scales.
    """

    def __init__(self, products: Products, fixed: Integers, fixed_sigma: Floats, index: Integers) -> None:
        own = products.gram[np.ix_(fixed, fixed)] * (fixed_sigma * fixed_sigma[:, None])
        size, axes = np.linalg.eigh(own)
        turned = fixed_sigma[:, None] * axes
        self._size = np.maximum(size, 0.0)
        self._across: Floats = turned.T @ products.gram[np.ix_(fixed, index)]
        self._along_fixed, self._along = turned.T @ products.along[fixed], products.along[index]
        self._gram = products.gram[np.ix_(index, index)]
        self._products = products

    def information(self, sigma: Floats, noise: float, number: Integers) -> Floats:
        """Return the Fisher information (s + 1, s + 1) about the logs of the scales of s blocks and of the noise.

        The degrees of freedom of the fixed columns are neglected, as the result is used only to choose axes.

        Args:
            sigma: (b,) scales.
            noise: noise variance.
            number: (b,) number of each column's block, in rising order.
        """
        known = np.eye(len(sigma)) - inverse_by(self._eliminate_fixed(sigma, noise)[2])
        first = np.flatnonzero(np.diff(number, prepend=-1))
        squares = np.add.reduceat(np.add.reduceat(known**2, first, axis=0), first, axis=1)
        kept = np.diag(known) - (known**2).sum(axis=0)
        with_noise = np.add.reduceat(kept, first)
        of_noise = self._products.rows - 2.0 * float(np.trace(known)) + float((known**2).sum())
        return np.block([[2.0 * squares, with_noise[:, None]], [with_noise, np.array([0.5 * of_noise])]])

    def evidence(self, sigma: Floats, noise: float) -> tuple[float, Floats, float]:
        """Return the log evidence, and its derivatives by the log of every scale (b,) and by the log of the noise.

        Args:
            sigma: (b,) scales.
            noise: noise variance.
        """
        products, size = self._products, self._size
        left, across, factor = self._eliminate_fixed(sigma, noise)
        fixed = self._along_fixed * np.sqrt(left / noise)
        score = sigma * (self._along - across.T @ fixed) / noise
        root = inverse_root_by(factor)
        half = root @ score
        mean = root.T @ half
        explained = float(fixed @ fixed) / noise + float(half @ half)
        value = 0.5 * (explained - products.squares / noise - products.rows * np.log(noise))
        value -= float(np.log(np.diag(factor)).sum()) - 0.5 * float(np.log(left).sum())
        variance = np.einsum("ij,ij->j", root, root)
        slope: Floats = mean**2 + variance - 1.0
        # Fixed columns: posterior means in prior sigmas, and variances including the uncertainty of the scaled columns.
        mean_fixed = np.sqrt(left / noise) * (fixed - across @ (sigma * mean))
        open_to_others = (blas.dtrmm(1.0, root, (across * sigma).T, lower=1) ** 2).sum(axis=0) / noise
        of_fixed = float(left.sum()) + float(open_to_others @ left)
        # Sum of squares of the residuals of the posterior mean, divided by the noise.
        squares = products.squares / noise - explained - float(mean @ mean) - float(mean_fixed @ mean_fixed)
        count = len(size) + len(sigma)
        return value, slope, 0.5 * (squares + count - float(variance.sum()) - of_fixed - products.rows)

    def _eliminate_fixed(self, sigma: Floats, noise: float) -> tuple[Floats, Floats, Floats]:
        """Eliminate the fixed columns.

        Args:
            sigma: (b,) scales.
            noise: noise variance.

        Returns:
            The remaining share (f,) of the prior variance along the axes of the fixed columns; products (f, b) of these
            axes with the scaled columns; the Cholesky factor (b, b) of the scaled columns' posterior precision, in
            prior sigmas.
        """
        left = noise / (noise + self._size)
        across = self._across * np.sqrt(left / noise)[:, None]
        matrix = (self._gram - across.T @ across) * (sigma * sigma[:, None] / noise)
        matrix[np.diag_indices_from(matrix)] += 1.0
        factor, failed = lapack.dpotrf(matrix, lower=1)
        if failed:  # for data without noise the difference is only rounding error; all true eigenvalues are at least 1
            size, axes = np.linalg.eigh(matrix)
            factor = np.linalg.cholesky(axes * np.maximum(size, 1.0) @ axes.T)
        return left, across, factor
