"""Residuals of a fit with the freedom of its kinematics projected out: the space in which effects are scored.

A refit of the kinematics absorbs most of an effect's displacements, so an effect is scored by the part that it cannot
absorb. At the fit the model is linear and normal, y = J x + C c + noise, x ~ N(0, P). With J P J' counted as noise, and
everything whitened,

    Sigma^-1/2 y = Sigma^-1/2 C c + N(0, I),    Sigma = V + J P J',

the kinematics are projected out softly: directions that the priors determine are kept, and an infinite prior gives the
orthogonal projection of Frisch and Waugh (Econometrica 1, 1933).
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
    """Soft projection of whitened rows off the kinematics, limited by their prior: (I + K K')^-1/2.

    Args:
        kinematics: (r, q) matrix K, whitened columns in prior sigmas.
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
        # Computed from a triangular root of I + K'K, as squaring would lose the precision of small singular values.
        _, root, axes = np.linalg.svd(self._root.T)
        middle: Floats = axes.T / (root * (1.0 + root)) @ axes
        return middle

    @cached_property
    def _inverse(self) -> Floats:
        """(q, q) inverse of the triangular root of I + K'K."""
        return np.asarray(lapack.dtrtri(self._root, lower=1)[0])

    @property
    def degrees_of_freedom(self) -> float:
        """Effective number of directions that the kinematics remove from the rows: trace of K (I + K'K)^-1 K'."""
        return len(self._inverse) - float((self._inverse**2).sum())

    def removed(self, whitened: Floats) -> Floats:
        """Return the components (q, k) of rows (r, k), or (q,) of (r,), along the kinematics.

        a'b minus the product of the removed components of a and b is the product of the projected a and b.
        """
        return self.removed_by(self._kinematics.T @ whitened)

    def removed_by(self, products: Floats) -> Floats:
        """Return `removed` (..., q, k) for rows whose products with the kinematics (..., q, k) are given."""
        removed: Floats = self._inverse @ products
        return removed


class Projection:
    """Linear model of m samples at a fit, with its kinematics projected out.

    Args:
        solution: kinematics and the effects adopted so far, as fitted.
        context: context of the n observations.
        fit: the fit that gives noise and outlier weights; `solution`'s own by default.
        tried: an effect of `fit` in addition to the adopted ones. It is not projected out, but its fitted coefficients
            are part of the linearisation point.

    Attributes:
        samples, context: as above.
        groups: (m,) labels of groups that folds do not split: stretches of a path, or workspace cells; a standstill is
            always in one group.
        joint_jacobian: (m, 3, joints) derivatives by reading, station's frame, mm per deg or mm.
        jacobian: (m, 3, p) derivatives by the chain's parameters, mm per mm or rad.
        error_mm: (m, 3) measured minus fitted positions, including outliers, station's frame.
        target: (3 m,) whitened positions to be explained by kinematics and effects.
        kinematics: (3 m, q) whitened displacement by one prior sigma of each parameter and adopted coefficient.
        without_kinematics: the soft projection off `kinematics`.
    """

    def __init__(
        self, solution: Solution, context: EffectContext, fit: Fit | None = None, tried: EffectColumns | None = None
    ) -> None:
        self.samples: Samples = solution.samples
        self.context = context
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
        """(3 m,) projected target; independent standard normal if nothing is missing."""
        return self.without_kinematics(self.target)

    def whitened(self, moved_mm: Floats) -> Floats:
        """Return displacements (m, 3, k), mm in the station's frame, as (3 m, k) in units of the noise."""
        whitened: Floats = self._whiten(moved_mm)
        return whitened

    def whitened_by_reading(self, joint: int) -> csr_array:
        """Return (3 m, m) the whitened displacements by one unit of a joint's reading in each of the samples.

        A sample's displacement is nonzero only in the rows of its own standstill, whose fixes have correlated noise.

        Args:
            joint: index of the joint in the chain.
        """
        standstill = np.unique(self.samples.standstill, return_inverse=True)[1]
        order = np.argsort(standstill, kind="stable")
        first = np.searchsorted(standstill[order], standstill)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        place -= first  # index of each sample within its standstill
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
        """Return errors (m, 3) of every sample in the linear model fitted without its fold (m,), mm."""
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

        The solution uses the weights of the projection, which a nonlinear fit from a different start may not reach.

        Args:
            more: columns of the further coefficients, for the samples.

        Returns:
            (q + k,) parameters, adopted coefficients and further coefficients.
        """
        sigma = more.prior_sigma
        design = np.hstack([self.kinematics, self.whitened(self.moved_mm(more)) * sigma])
        normal = gram(design) + np.eye(design.shape[1])
        x = np.linalg.solve(normal, design.T @ self.target)
        kept = self.kinematics.shape[1]
        solved: Floats = x * np.concatenate([1.0 / self._found.precision_root[:kept], sigma])
        return solved

    def moved_mm(self, additions: EffectColumns) -> Floats:
        """Return displacements (m, 3, k) by unit coefficients of `additions`, mm."""
        return additions.moved_mm(self.joint_jacobian)


def follows_path(samples: Samples) -> bool:
    """Return True if the poses follow one path, rather than being independent of each other."""
    return path_stretches(samples.data.readings, samples.data.setup) is not None


def cells(samples: Samples) -> Labels:
    """Return labels (m,) for grouped splits: stretches of a path, or workspace cells; standstills are not split.

    Set-ups and sessions are not used as groups, as a set-up's base, a part of the fit, is undetermined without its
    fixes.
    """
    setup = samples.data.setup
    first = np.arange(len(samples)) if samples.standstill is None else samples.standstill
    stretch = path_stretches(samples.data.readings, setup)
    if stretch is not None:
        return np.array([f"{s}|stretch {n}" for s, n in zip(setup[first], stretch[first], strict=True)])
    cell = np.rint(samples.position_mm / cell_mm(samples.position_mm, setup)).astype(int)
    return np.array([f"{s}|{x},{y},{z}" for s, (x, y, z) in zip(setup[first], cell[first], strict=True)])


def without_folds(design: Floats, target: Floats, fold: Integers) -> Iterator[tuple[int, Floats]]:
    """Yield the number of every fold with the solution of the linear model without it.

    Args:
        design: (3 m, q) whitened columns, in prior sigmas.
        target: (3 m,) whitened target.
        fold: (m,) fold number of each sample.
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
    """Return the row indices (3 s,) of the given samples."""
    index: Integers = (3 * np.asarray(samples, dtype=np.intp)[:, None] + np.arange(3)).ravel()
    return index
