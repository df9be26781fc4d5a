"""Evidence of a linear normal model in closed form, from products of its columns alone, and its greatest scales.

y = C c + noise with c normal: the log evidence and its derivative by the scale of every block of columns, and by that
of the noise, need C'C, C'y and y'y only (Tipping, JMLR 1, 2001). So hundreds of models are compared at a cost that
does not depend on the number of rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.optimize import minimize

from calibration.observations import Floats

Integers = NDArray[np.intp]

_LOG_SCALE = (-9.0, 5.0)  # of plausible sizes
_MOST_NOISE = 12.0  # log of its variance, of the one that rows are whitened with


@dataclass(frozen=True)
class Products:
    """Products of whitened columns.

    Attributes:
        gram: (t, t) of all columns with each other, in prior sigmas.
        along: (t,) with the target.
        squares: of the target.
        rows: number of rows.
        least_noise: least variance of the noise, of the one that rows are whitened with.
    """

    gram: Floats
    along: Floats
    squares: float
    rows: int
    least_noise: float


@dataclass(frozen=True)
class Scales:
    """Scales of greatest evidence.

    Attributes:
        fixed: (f,) columns whose scales stay.
        fixed_sigma: (f,) those scales.
        blocks: name -> its columns.
        log_scale: name -> log of the factor on its prior sigmas.
        noise: variance of the noise, of the one that rows are whitened with.
        log_evidence: of the model, up to a constant of the rows.
    """

    fixed: Integers
    fixed_sigma: Floats
    blocks: Mapping[str, Integers]
    log_scale: Mapping[str, float]
    noise: float
    log_evidence: float

    @property
    def index(self) -> Integers:
        """(q,) all columns of the model."""
        return np.concatenate([self.fixed, *self.blocks.values()]).astype(np.intp)

    @property
    def sigma(self) -> Floats:
        """(q,) factors on the prior sigmas of these columns."""
        own = [np.full(len(v), np.exp(self.log_scale[k])) for k, v in self.blocks.items()]
        return np.concatenate([self.fixed_sigma, *own])


def greatest(
    products: Products,
    fixed: Integers,
    fixed_sigma: Floats,
    blocks: Mapping[str, Integers],
    start: Mapping[str, float],
    noise: float,
    iterations: int,
) -> Scales:
    """Return the scales of blocks and noise that have the greatest evidence.

    Args:
        products: of the whitened columns.
        fixed: (f,) columns whose scales stay.
        fixed_sigma: (f,) those scales.
        blocks: name -> its columns.
        start: name -> log scale to start from.
        noise: to start from.
        iterations: at most.
    """
    names = list(blocks)
    index = np.concatenate([fixed, *blocks.values()]).astype(np.intp)
    number = np.repeat(np.arange(-1, len(names)), [len(fixed), *map(len, blocks.values())])
    gram, along = products.gram[np.ix_(index, index)], products.along[index]

    def negative(theta: Floats) -> tuple[float, Floats]:
        sigma = np.exp(np.append(theta[:-1], 0.0)[number])
        sigma[: len(fixed)] = fixed_sigma
        value, slope, by_noise = _evidence(products, gram, along, sigma, float(np.exp(theta[-1])))
        return -value, -np.append(np.bincount(number + 1, slope, minlength=len(names) + 1)[1:], by_noise)

    least = float(np.log(products.least_noise))
    theta = np.append([np.clip(start[name], *_LOG_SCALE) for name in names], max(float(np.log(noise)), least))
    bounds = [_LOG_SCALE] * len(names) + [(least, _MOST_NOISE)]
    found = minimize(negative, theta, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations})
    scale = dict(zip(names, found.x[:-1].tolist(), strict=True))
    return Scales(fixed, fixed_sigma, dict(blocks), scale, float(np.exp(found.x[-1])), -float(found.fun))


def _evidence(
    products: Products, gram: Floats, along: Floats, sigma: Floats, noise: float
) -> tuple[float, Floats, float]:
    """Return the log evidence of a model, its derivatives by the log of every sigma (q,), and by that of the noise.

    Args:
        products: of the whole.
        gram: (q, q) of the model's columns.
        along: (q,) of the same with the target.
        sigma: (q,) of their amounts.
        noise: variance.
    """
    matrix = gram * (sigma * sigma[:, None] / noise)
    matrix[np.diag_indices_from(matrix)] += 1.0
    factor = cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
    half = solve_triangular(factor, along * sigma / noise, lower=True, check_finite=False)
    explained = float(half @ half)
    value = 0.5 * (explained - products.squares / noise - products.rows * np.log(noise))
    value -= float(np.log(np.diag(factor)).sum())
    mean = solve_triangular(factor, half, lower=True, trans=1, check_finite=False)
    variance = (lapack.dtrtri(factor, lower=1)[0] ** 2).sum(axis=0)
    slope: Floats = mean**2 + variance - 1.0
    # The squares that the posterior mean leaves, over the noise.
    left = products.squares / noise - explained - float(mean @ mean)
    return value, slope, 0.5 * (left + len(sigma) - float(variance.sum()) - products.rows)
