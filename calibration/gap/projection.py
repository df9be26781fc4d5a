"""Residuals of a fit with the freedom of its kinematics projected out: the space in which effects are scored.

A refit of the kinematics absorbs most of what an effect does, so an effect counts by what it cannot. About the fit the
model is linear and normal, y = J x + C c + noise, x ~ N(0, P): with J P J' counted as noise and all of it whitened,

    Sigma^-1/2 y = Sigma^-1/2 C c + N(0, I),    Sigma = V + J P J',

kinematics are projected out softly: nothing is lost along what the priors know, and an infinite prior is the orthogonal
projection of Frisch and Waugh (Econometrica 1, 1933).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
from scipy.sparse import csr_array

from calibration.effects.columns import EffectColumns, joined
from calibration.effects.context import EffectContext
from calibration.identification.refinement import Fit, whitened_rows
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution
from calibration.numerics.groups import path_stretches
from calibration.numerics.matrices import gram
from calibration.observations import Floats, cell_mm

Labels = NDArray[np.str_]
Integers = NDArray[np.intp]


class SoftProjection:
    """Projection of whitened rows off the kinematics as far as their prior lets these move: (I + K K')^-1/2.

    Args:
        kinematics: (r, q) K.
    """

    def __init__(self, kinematics: Floats) -> None:
        self._kinematics = kinematics
        self._root = np.linalg.cholesky(gram(kinematics) + np.eye(kinematics.shape[1]))

    def __call__(self, whitened: Floats) -> Floats:
        """Return rows (r, k) or (r,) in units of noise and kinematics together."""
        out: Floats = whitened - self._kinematics @ (self._middle @ (self._kinematics.T @ whitened))
        return out

    @cached_property
    def _middle(self) -> Floats:
        # Of a triangular root of I + K'K, whose small singular values do not suffer from the large ones' squares.
        _, root, axes = np.linalg.svd(self._root.T)
        middle: Floats = axes.T / (root * (1.0 + root)) @ axes
        return middle

    @cached_property
    def _inverse(self) -> Floats:
        """(q, q) inverse of the triangular root of I + K'K."""
        return np.asarray(lapack.dtrtri(self._root, lower=1)[0])

    @property
    def degrees_of_freedom(self) -> float:
        """Number of directions that the kinematics take out of the rows: trace of K (I + K'K)^-1 K'."""
        return len(self._inverse) - float((self._inverse**2).sum())

    def removed(self, whitened: Floats) -> Floats:
        """Return (q, k) the part of rows (r, k), or (q,) of (r,), along the kinematics.

        a'b less the product of both removed parts is the product of the projected a and b.
        """
        return self.removed_by(self._kinematics.T @ whitened)

    def removed_by(self, products: Floats) -> Floats:
        """Return `removed` (..., q, k) of rows whose products with the kinematics (..., q, k) are given."""
        removed: Floats = self._inverse @ products
        return removed


class Projection:
    """Linear model of m samples about a fit, with its kinematics projected out.

    Args:
        solution: kinematics and the effects adopted so far, as fitted.
        situation: of the n observations.
        fit: noise and outliers are taken from it; `solution`'s own by default.
        tried: an effect that `fit` has in addition to those adopted: it is not projected out, but the model is linear
            about its coefficients.

    Attributes:
        samples, situation: as above.
        groups: (m,) stretches of a path or workspace cells, a standstill in one of them; no fold separates them.
        joint_jacobian: (m, 3, joints) by reading, station's frame, mm per deg or mm.
        jacobian: (m, 3, p) by the chain's parameters, mm per mm or rad.
        error_mm: (m, 3) measured minus fitted positions, outliers included, station's frame.
        target: (3 m,) whitened positions that kinematics and effects have to explain.
        kinematics: (3 m, q) whitened displacement by one prior sigma of each parameter and adopted coefficient.
        without_kinematics: the soft projection off `kinematics`.
    """

    def __init__(
        self, solution: Solution, situation: EffectContext, fit: Fit | None = None, tried: EffectColumns | None = None
    ) -> None:
        self.samples: Samples = solution.samples
        self.situation = situation
        fit = solution.fit if fit is None else fit
        parts = [part for part in (solution.additions, tried) if part is not None]
        additions = joined(parts, len(self.samples)) if parts else None
        found = whitened_rows(solution.chain, self.samples, fit, additions)
        kept = len(fit.x) - (0 if tried is None else len(tried))
        self._found, self._additions = found, additions
        self._whiten = found.whiten
        self.joint_jacobian, self.jacobian = found.joint_jacobian, found.parameter_jacobian
        self.error_mm = found.error_mm
        self.groups = cells(self.samples)
        self.fit = fit
        self.target = found.error + found.jacobian @ found.value
        self.kinematics = found.jacobian[:, :kept]
        self.without_kinematics = SoftProjection(self.kinematics)

    @cached_property
    def residual(self) -> Floats:
        """(3 m,) projected target; independent standard normal numbers if nothing is missing."""
        return self.without_kinematics(self.target)

    def whitened(self, moved_mm: Floats) -> Floats:
        """Return displacements (m, 3, k), mm in the station's frame, as (3 m, k) in units of the noise."""
        whitened: Floats = self._whiten(moved_mm)
        return whitened

    def whitened_by_reading(self, joint: int) -> csr_array:
        """Return (3 m, m) the whitened displacements by one unit of a joint's reading in each of the samples.

        A sample's displacement is seen in the rows of its own standstill alone: its fixes share noise.

        Args:
            joint: its index in the chain.
        """
        standstill = np.unique(self.samples.standstill, return_inverse=True)[1]
        order = np.argsort(standstill, kind="stable")
        first = np.searchsorted(standstill[order], standstill)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        place -= first  # of each sample among those of its standstill
        width = int(place.max()) + 1
        at = self.joint_jacobian[:, :, joint, None] * (place[:, None, None] == np.arange(width))
        sample = order[np.minimum(first[:, None] + np.arange(width), len(order) - 1)]
        is_own = standstill[sample] == standstill[:, None]
        column, shown = np.repeat(sample, 3, axis=0), np.repeat(is_own, 3, axis=0)
        row = np.repeat(np.arange(len(column)), shown.sum(axis=1))
        shape = (len(column), len(order))
        return csr_array((self._whiten(at)[shown], (row, column[shown])), shape=shape)

    def columns(self, moved_mm: Floats) -> Floats:
        """Return displacements (m, 3, k) as (3 m, k) in the projected space of `residual`."""
        return self.without_kinematics(self._whiten(moved_mm))

    def held_out_mm(self, fold: Integers) -> Floats:
        """Return (m, 3) errors of every sample by the linear model fitted without its fold (m,)."""
        found = self._found
        moved = [found.parameter_jacobian]
        if self._additions is not None:
            moved.append(self._additions.moved_mm(found.joint_jacobian))
        design = np.concatenate(moved, axis=2) / found.precision_root
        errors = np.empty_like(self.error_mm)
        for number, x in without_folds(found.jacobian, self.target, fold):
            rows = fold == number
            errors[rows] = self.error_mm[rows] - design[rows] @ (x - found.value)
        return errors

    def solved(self, more: EffectColumns) -> Floats:
        """Solve the linear model with further coefficients.

        It counts every fix as the projection does; a fit from another start may never come to that.

        Args:
            more: the further coefficients, for the samples.

        Returns:
            (q + k,) parameters, adopted coefficients and further ones.
        """
        sigma = more.prior_sigma
        design = np.hstack([self.kinematics, self.whitened(self.moved_mm(more)) * sigma])
        normal = gram(design) + np.eye(design.shape[1])
        x = np.linalg.solve(normal, design.T @ self.target)
        kept = self.kinematics.shape[1]
        solved: Floats = x * np.concatenate([1.0 / self._found.precision_root[:kept], sigma])
        return solved

    def moved_mm(self, additions: EffectColumns) -> Floats:
        """Return (m, 3, k) the displacements by unit coefficients of the samples' additions."""
        return additions.moved_mm(self.joint_jacobian)


def follows_path(samples: Samples) -> bool:
    """True if the poses follow one path, and are not taken one independently of the other."""
    return path_stretches(samples.data.readings, samples.data.setup) is not None


def cells(samples: Samples) -> Labels:
    """Return (m,) labels for grouped splits: stretches of a path, else workspace cells; a standstill is in one of them.

    Set-ups and sessions are no groups here: without a set-up's fixes its base, a part of the fit, is undetermined.
    """
    setup = samples.data.setup
    first = np.arange(len(samples)) if samples.standstill is None else samples.standstill
    stretch = path_stretches(samples.data.readings, setup)
    if stretch is not None:
        return np.array([f"{s}|stretch {n}" for s, n in zip(setup[first], stretch[first], strict=True)])
    cell = np.rint(samples.position_mm / cell_mm(samples.position_mm, setup)).astype(int)
    return np.array([f"{s}|{x},{y},{z}" for s, (x, y, z) in zip(setup[first], cell[first], strict=True)])


def without_folds(design: Floats, target: Floats, fold: Integers) -> Iterator[tuple[int, Floats]]:
    """Yield every fold with the solution of the linear model without it.

    Args:
        design: (3 m, q) whitened columns, in prior sigmas.
        target: (3 m,).
        fold: (m,) of each sample.
    """
    whole, right = design.T @ design, design.T @ target
    for number in np.unique(fold):
        rows = rows_of(np.flatnonzero(fold == number))
        own = design[rows]
        factor = cho_factor(whole - own.T @ own + np.eye(len(whole)), lower=True)
        yield int(number), cho_solve(factor, right - own.T @ target[rows])


def from_products(gram: Floats, along: Floats, sigma: Floats) -> float:
    """Return the log Bayes factor of columns G against the model without them, in closed form.

    1/2 b'A^-1 b - 1/2 ln |A|, A = I + S G'G S, b = S G'r.

    Args:
        gram: (k, k) G'G.
        along: (k,) G'r.
        sigma: (k,) prior standard deviations, the diagonal of S.
    """
    matrix = np.eye(len(sigma)) + gram * sigma * sigma[:, None]
    factor = np.linalg.cholesky(matrix)
    solved = solve_triangular(factor, along * sigma, lower=True, check_finite=False)
    return 0.5 * float(solved @ solved) - float(np.log(np.diag(factor)).sum())


def rows_of(samples: Sequence[int] | Integers) -> Integers:
    """Return (3 s,) the rows of the given samples."""
    index: Integers = (3 * np.asarray(samples, dtype=np.intp)[:, None] + np.arange(3)).ravel()
    return index
