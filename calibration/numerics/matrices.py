"""Products of columns that are mostly zero, inverses by Cholesky factors, and roots of covariances.

A curve over a joint's angle has dozens of splines, of which four are not zero at a fix. So a row has only a few of the
hundreds of coefficients of several curves. Products are summed over the nonzero values of each row.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from calibration.numerics.jit import compiled
from calibration.observations import Floats

Integers = NDArray[np.intp]

_RARE = 0.25  # greatest share of nonzero rows in a rare column
_WORTHWHILE = 50  # rare columns; with fewer, products of all columns are as fast


def gram(rows: Floats) -> Floats:
    """Return the (q, q) products rows' rows of all columns of `rows` (r, q) with each other."""
    rare = _filled(np.ascontiguousarray(rows)) <= _RARE * len(rows)
    if rare.sum() < _WORTHWHILE:
        product: Floats = rows.T @ rows
        return product
    seldom, often = np.flatnonzero(rare), np.flatnonzero(~rare)
    beside, own = np.zeros((len(seldom), len(often))), np.zeros((len(seldom), len(seldom)))
    _add(np.ascontiguousarray(rows), seldom, often, beside, own)
    usual, out = rows[:, often], np.empty((rows.shape[1], rows.shape[1]))
    _place(often, seldom, usual.T @ usual, beside, own, out)
    return out


@compiled
def _place(often: Integers, seldom: Integers, usual: Floats, beside: Floats, own: Floats, out: Floats) -> None:
    """Write the products within and between the columns `often` (p,) and `seldom` (s,) into `out` (q, q).

    `usual` is (p, p), `beside` (s, p); of `own` (s, s) only the lower triangle is filled.
    """
    for i in range(len(often)):
        for k in range(len(often)):
            out[often[i], often[k]] = usual[i, k]
    for i in range(len(seldom)):
        for k in range(len(often)):
            out[seldom[i], often[k]] = beside[i, k]
            out[often[k], seldom[i]] = beside[i, k]
        for k in range(i + 1):
            out[seldom[i], seldom[k]] = own[i, k]
            out[seldom[k], seldom[i]] = own[i, k]


@compiled
def _filled(rows: Floats) -> Integers:
    """Return the (q,) number of nonzero values in each column of rows (r, q)."""
    out = np.zeros(rows.shape[1], dtype=np.intp)
    for r in range(len(rows)):
        for k in range(rows.shape[1]):
            out[k] += rows[r, k] != 0.0
    return out


@compiled
def _add(rows: Floats, seldom: Integers, often: Integers, beside: Floats, own: Floats) -> None:
    """Add the products of the columns `seldom` (s,) of rows (r, q) with the columns `often` (p,) and with each other.

    `beside` is (s, p); of `own` (s, s) only the lower triangle is filled.
    """
    at, value, usual = np.empty(len(seldom), dtype=np.intp), np.empty(len(seldom)), np.empty(len(often))
    for r in range(len(rows)):
        row, found = rows[r], 0
        for i in range(len(seldom)):
            at[found], value[found] = i, row[seldom[i]]
            found += value[found] != 0.0
        for k in range(len(often)):
            usual[k] = row[often[k]]
        for a in range(found):
            with_usual, with_rare = beside[at[a]], own[at[a]]
            for k in range(len(often)):
                with_usual[k] += value[a] * usual[k]
            for b in range(a + 1):
                with_rare[at[b]] += value[a] * value[b]


def inverse_by(factor: Floats) -> Floats:
    """Return the inverse (q, q) of the matrix with a lower Cholesky factor, whose upper triangle is ignored."""
    if not len(factor):
        return factor
    lower = np.tril(lapack.dpotri(factor, lower=1)[0])
    inverse: Floats = lower + lower.T
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return inverse


def inverse_root_by(factor: Floats) -> Floats:
    """Return the lower triangular (q, q) root, inverse = root' root, for the matrix of a lower Cholesky factor."""
    root: Floats = lapack.dtrtri(factor, lower=1)[0] if len(factor) else factor
    return root


def root_of(covariance: Floats) -> Floats:
    """Return a root (q, q) of a covariance that may be singular: root @ root' is the covariance."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0.0] = 1.0
    value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
    root: Floats = scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
    return root


def traces(matrices: Floats) -> Floats:
    """Return the traces (...) of matrices (..., q, q)."""
    return np.asarray(np.trace(matrices, axis1=-2, axis2=-1), dtype=np.float64)


def triangular(root: Floats) -> Floats:
    """Return the lower triangular root (q, q) of the same covariance as another root (q, q)."""
    return np.ascontiguousarray(np.linalg.qr(root.T).R.T)
