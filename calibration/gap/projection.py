"""What a fit leaves, with the freedom of its kinematics taken out: the space in which effects are weighed.

A refit of the kinematics absorbs most of what an effect does, so an effect counts by what it cannot. About the fit the
model is linear and normal, y = J x + C c + noise, x ~ N(0, P): with J P J' counted as noise and all of it whitened,

    Sigma^-1/2 y = Sigma^-1/2 C c + N(0, I),    Sigma = V + J P J',

kinematics are gone softly: along what the priors know, nothing is lost, and an infinite prior would be the orthogonal
projection of Frisch and Waugh (Econometrica 1, 1933).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from calibration.effects.base import Situation
from calibration.identification.additions import Additions, joined
from calibration.identification.refinement import Fit, whitened_rows
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution
from calibration.kernels.gram import gram
from calibration.observations import Floats, cell_mm

Labels = NDArray[np.str_]
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Rows:
    """Whitened rows of samples, in which kinematics are still free.

    Attributes:
        target: (r,) what kinematics and effects have to explain.
        kinematics: (r, q) what one prior sigma of each parameter, and of each coefficient already adopted, moves.
    """

    target: Floats
    kinematics: Floats


class Softly:
    """Takes the kinematics out of whitened rows: the symmetric root of (I + K K')^-1.

    Args:
        kinematics: (r, q) K.
    """

    def __init__(self, kinematics: Floats) -> None:
        # Of a triangular root of I + K'K, whose small singular values do not suffer from the large ones' squares.
        _, root, axes = np.linalg.svd(np.linalg.cholesky(gram(kinematics) + np.eye(kinematics.shape[1])).T)
        self._kinematics = kinematics
        self._half = axes.T / root
        self._middle: Floats = axes.T / (root * (1.0 + root)) @ axes

    def __call__(self, whitened: Floats) -> Floats:
        """(r, k) or (r,) in units of noise and kinematics together."""
        out: Floats = whitened - self._kinematics @ (self._middle @ (self._kinematics.T @ whitened))
        return out

    def taken(self, whitened: Floats) -> Floats:
        """(q, k) of rows (r, k), or (q,): a'b less the product of what is taken of both is that of what is left."""
        taken: Floats = self._half.T @ (self._kinematics.T @ whitened)
        return taken


class Projection:
    """m samples about a fit.

    Args:
        solution: kinematics and the effects adopted so far, as fitted.
        situation: of the n observations.
        fit: noise and outliers are taken from it; `solution`'s own by default.
        tried: an effect that `fit` has beside those adopted: it is no part of what is taken out, but the model is
            linear about where it is.

    Attributes:
        samples, situation: as above.
        groups: (m,) workspace cells, a standstill in that of its first sample; no fold separates them.
        joint_jacobian: (m, 3, joints) by reading, station's frame, mm per deg or mm.
        jacobian: (m, 3, p) by the chain's parameters, mm per mm or rad.
        error_mm: (m, 3) what the fit leaves of the samples, outliers too, station's frame.
        rows: the whitened rows before the kinematics are taken out.
        residual: (3 m,) what is left; independent standard normal numbers if nothing is missing.
    """

    def __init__(
        self, solution: Solution, situation: Situation, fit: Fit | None = None, tried: Additions | None = None
    ) -> None:
        self.samples: Samples = solution.samples
        self.situation = situation
        fit = solution.fit if fit is None else fit
        parts = [part for part in (solution.additions, tried) if part is not None]
        additions = joined(parts, len(self.samples)) if parts else None
        found = whitened_rows(
            solution.chain,
            self.samples,
            fit,
            excess_variance=fit.excess_variance,
            weight=fit.weight,
            additions=additions,
        )
        kept = len(fit.x) - (0 if tried is None else len(tried))
        self._found, self._additions = found, additions
        self._whiten = found.whiten
        self.joint_jacobian, self.jacobian = found.joint_jacobian, found.parameter_jacobian
        self.error_mm = found.error_mm
        self.groups = cells(self.samples)
        self.fit = fit
        self.rows = Rows(found.error + found.jacobian @ found.value, found.jacobian[:, :kept])
        self.softly = Softly(self.rows.kinematics)
        self.residual = self.softly(self.rows.target)

    def whitened(self, moved_mm: Floats) -> Floats:
        """(3 m, k) displacements (m, 3, k), mm in the station's frame, in units of the noise."""
        whitened: Floats = self._whiten(moved_mm)
        return whitened

    def columns(self, moved_mm: Floats) -> Floats:
        """(3 m, k) the same with the kinematics taken out, as `residual`."""
        return self.softly(self._whiten(moved_mm))

    def held_out_mm(self, fold: Integers) -> Floats:
        """(m, 3) errors of every sample by the model fitted without its fold (m,), linear about the fit."""
        found = self._found
        moved = [found.parameter_jacobian]
        if self._additions is not None:
            moved.append(self._additions.moved_mm(found.joint_jacobian))
        design = np.concatenate(moved, axis=2) / found.precision_root
        errors = np.empty_like(self.error_mm)
        for number, x in without_folds(found.jacobian, self.rows.target, fold):
            rows = fold == number
            errors[rows] = self.error_mm[rows] - design[rows] @ (x - found.value)
        return errors

    def solved(self, more: Additions) -> Floats:
        """(q + k,) where the linear model has parameters, what was adopted, and further coefficients.

        With every fix counted as the projection does, which a fit from elsewhere may never come to.

        Args:
            more: the further coefficients, for the samples.
        """
        sigma = more.prior_sigma
        design = np.hstack([self.rows.kinematics, self.whitened(self.moved_mm(more)) * sigma])
        normal = gram(design) + np.eye(design.shape[1])
        x = np.linalg.solve(normal, design.T @ self.rows.target)
        kept = self.rows.kinematics.shape[1]
        solved: Floats = x * np.concatenate([1.0 / self._found.precision_root[:kept], sigma])
        return solved

    def moved_mm(self, additions: Additions) -> Floats:
        """(m, 3, k) what unit coefficients move, for additions of the samples."""
        return additions.moved_mm(self.joint_jacobian)


def cells(samples: Samples) -> Labels:
    """(m,) workspace cells for grouped splits, a standstill in that of its first sample.

    Set-ups and sessions are no groups here: without a set-up's fixes its base, a part of the fit, has no place.
    """
    setup = samples.data.setup
    cell = np.rint(samples.position_mm / cell_mm(samples.position_mm, setup)).astype(int)
    first = np.arange(len(samples)) if samples.standstill is None else samples.standstill
    return np.array([f"{s}|{x},{y},{z}" for s, (x, y, z) in zip(setup[first], cell[first], strict=True)])


def without_folds(design: Floats, target: Floats, fold: Integers) -> Iterator[tuple[int, Floats]]:
    """Every fold with the (q,) solution, in prior sigmas, of whitened rows (3 m, q) without its samples (m,)."""
    whole, right = design.T @ design, design.T @ target
    for number in np.unique(fold):
        rows = rows_of(np.flatnonzero(fold == number))
        own = design[rows]
        factor = cho_factor(whole - own.T @ own + np.eye(len(whole)), lower=True)
        yield int(number), cho_solve(factor, right - own.T @ target[rows])


def from_products(gram: Floats, along: Floats, sigma: Floats) -> float:
    """ln of the evidence of columns with prior sigmas (k,) over that of nothing, from G'G (k, k) and G'r (k,).

    1/2 b'A^-1 b - 1/2 ln |A|, A = I + S G'G S, b = S G'r.
    """
    matrix = np.eye(len(sigma)) + gram * sigma * sigma[:, None]
    factor = np.linalg.cholesky(matrix)
    solved = np.linalg.solve(factor, along * sigma)
    return 0.5 * float(solved @ solved) - float(np.log(np.diag(factor)).sum())


def rows_of(samples: Sequence[int] | Integers) -> Integers:
    """(3 s,) rows of the given samples."""
    index: Integers = (3 * np.asarray(samples, dtype=np.intp)[:, None] + np.arange(3)).ravel()
    return index
