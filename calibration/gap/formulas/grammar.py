"""Formulas for errors outside the library, selected by the data.

Each term is a single column in the projected space. The order of magnitude of its coefficient is unknown, so its
evidence is the mean of the closed form of `projection.from_products` over prior sigmas from one standard error up to
obvious sizes. Several terms are found one after the other, each in the residuals of the preceding ones (orthogonal
matching pursuit: Pati, Rezaiifar and Krishnaprasad, Asilomar 1993), from several starts. This is because where an error
has two terms, such as a wave of arbitrary phase, a third term may resemble their sum and beat each of them alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibration.gap.formulas.terms import Term, all_terms, chunks, columns_of
from calibration.gap.formulas.variables import Variables
from calibration.gap.projected.projection import Projection, SoftProjection
from calibration.observations import Floats

_LEAST_SEEN = 1e-3  # smallest visible share of a term's displacement, relative to the largest; less is rounding
_SIZES = 4.0 ** np.arange(1, 13)  # prior sigma^2 in standard errors^2
_KEPT = 1e7  # largest number of column values to cache
_BLOCKS = 1000  # largest number of blocks of groups, for the sums by group
_MOST = 3  # terms of a description
_BEGINNINGS = 12
_WORTH = math.log(99.0)  # log odds required for a term
_NEARLY = math.log(10.0)
_LEAST_OWN = 1e-3  # smallest share of a term's square that is orthogonal to preceding terms
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Formula:
    """A term that the data require, with its fitted coefficient.

    Attributes:
        term: the term.
        coefficient, standard_error: from a joint fit of all found terms, in the unit of
            `term.source.coefficient_unit(term.variable)`.
        log_evidence: log Bayes factor against the preceding terms, including the prior odds among all terms.
        column: (3 m,) unit column of the term in the projected space.
    """

    term: Term
    coefficient: float
    standard_error: float
    log_evidence: float
    column: Floats

    def adds_to(self, columns: Floats, residual: Floats) -> bool:
        """Return True if the data require the term in addition to an effect.

        Args:
            columns: (3 m, k) columns of the effect in the projected space, in prior sigmas.
            residual: (3 m,) residuals in the projected space.
        """
        without_effect = SoftProjection(columns)
        column = without_effect(self.column)
        square = (column @ without_effect(residual)) ** 2 / max(float(column @ column), _TINY)
        return bool(_log_bayes_factor(np.array([square]))[0] > _WORTH)


@dataclass(frozen=True)
class _Path:
    """A sequence of selected terms.

    Attributes:
        chosen: indices of the terms.
        evidence: log evidence of each term when it was selected.
        odds: logarithm of the prior odds and of the penalty for unknown coefficients (Occam factor).
        basis: (3 m, j) orthonormal basis of the selected columns.
        overlap: (j, k) products of the basis with all unit columns.
        left: remaining sum of squares of the residual.
    """

    chosen: tuple[int, ...]
    evidence: tuple[float, ...]
    odds: float
    basis: Floats
    overlap: Floats
    left: float

    def value(self, noise: float) -> float:
        """Return the joint log evidence of the terms; if less than `noise` is left, the noise is re-estimated."""
        if self.left > noise:
            return self.odds - 0.5 * self.left
        return self.odds - 0.5 * noise * (1.0 + math.log(max(self.left, _TINY) / noise))


class Grammar:
    """The terms of formulas in the projected space, with their scores.

    Args:
        projection: projection at the fit.
        possible: the terms; by default all terms of the grammar.

    Attributes:
        projection: as above.
        terms: the k terms that are visible in these data.
        score: (k,) score of each term, standard normal if nothing is missing.
        by_group: (blocks, k) contributions to the scores by blocks of sample groups.
    """

    def __init__(self, projection: Projection, possible: Sequence[Term] | None = None) -> None:
        self.projection = projection
        possible = all_terms(Variables(projection)) if possible is None else possible
        block = np.unique(projection.groups, return_inverse=True)[1] % _BLOCKS
        order = np.argsort(block, kind="stable")
        first = np.flatnonzero(np.diff(block[order], prepend=-1))
        residual = projection.residual.reshape(-1, 3)
        seen, by_group, lengths = [], [], []
        shape = 3 * len(residual), len(possible)
        kept = np.empty(shape, order="F") if math.prod(shape) <= _KEPT else None
        for part in chunks(possible, len(residual)):
            moved, columns, length = columns_of(projection, part)
            lengths.append(length)
            seen.append(length / np.maximum(np.sqrt((moved**2).sum(axis=(0, 1))), _TINY))
            by_sample = np.einsum("mck,mc->mk", columns.reshape(len(residual), 3, -1), residual)
            by_group.append(np.add.reduceat(by_sample[order], first, axis=0))
            if kept is not None:
                first_of_part = sum(map(len, seen[:-1]))
                kept[:, first_of_part : first_of_part + len(part)] = columns
        visible = np.concatenate(seen)
        shown = visible > _LEAST_SEEN * visible.max(initial=0.0)
        self.terms = tuple(term for term, is_shown in zip(possible, shown, strict=True) if is_shown)
        self.by_group = np.hstack(by_group)[:, shown]
        self.score: Floats = self.by_group.sum(axis=0)
        self._kept = None if kept is None else _of_shown(kept, shown)
        self._prior = np.array([term.log_prior for term in self.terms])
        self._largest = np.array([term.largest_coefficient for term in self.terms]) * np.concatenate(lengths)[shown]

    def find(self, most: int = _MOST) -> tuple[Formula, ...]:
        """Return the terms that the data require jointly, strongest first; empty if all may be chance.

        Args:
            most: largest number of terms.
        """
        residual = self.projection.residual
        squares = float(residual @ residual)
        noise = min(squares, float(len(residual)))
        empty = np.empty((len(residual), 0)), np.empty((0, len(self.terms)))
        paths = [_Path((), (), 0.0, *empty, squares)]
        for number in range(min(most, len(self.terms))):
            further: list[tuple[_Path, int, float, float]] = []
            ended: list[_Path] = []
            for path in paths:
                square, evidence = self._evidence(path, noise)
                best = [self._simplest(evidence)]
                if number == 0:
                    best += [i for i in np.argsort(-evidence, kind="stable")[:_BEGINNINGS].tolist() if i not in best]
                worth = [i for i in best if evidence[i] >= _WORTH]
                further += [(path, i, float(evidence[i]), float(square[i])) for i in worth]
                ended += [] if worth else [path]
            if not further:
                break
            paths = ended + self._extended(further)
        likeliest = max(paths, key=lambda path: path.value(noise))
        same = [path for path in paths if set(path.chosen) == set(likeliest.chosen)]
        return self._fitted(max(same, key=lambda path: path.evidence[:1]))

    def _evidence(self, path: _Path, noise: float) -> tuple[Floats, Floats]:
        """Return squared scores (k,) of all terms in the residuals of a path, and their log evidence (k,)."""
        # Errors that the preceding terms explain no longer count as noise for the next term.
        scale = min(1.0, path.left / noise)
        own = 1.0 - (path.overlap**2).sum(axis=0)
        score = self.score - path.overlap.T @ (path.basis.T @ self.projection.residual)
        coefficient = score / np.maximum(own, _LEAST_OWN)
        is_possible = (own > _LEAST_OWN) & (np.abs(coefficient) <= self._largest)
        square = np.where(is_possible, score * coefficient / scale, 0.0)
        return square, _log_bayes_factor(square) + self._prior

    def _extended(self, further: Sequence[tuple[_Path, int, float, float]]) -> list[_Path]:
        """Return paths with one more term each; `further` has (path, term, log evidence, squared score)."""
        residual = self.projection.residual
        column = columns_of(self.projection, [self.terms[i] for _, i, _, _ in further])[1]
        for number, (path, *_) in enumerate(further):
            own = column[:, number] - path.basis @ (path.basis.T @ column[:, number])
            column[:, number] = own / np.linalg.norm(own)
        overlap = self._products(column)
        return [
            _Path(
                (*path.chosen, i),
                (*path.evidence, evidence),
                path.odds + evidence - 0.5 * square,
                np.column_stack([path.basis, column[:, number]]),
                np.vstack([path.overlap, overlap[number]]),
                path.left - float(column[:, number] @ residual) ** 2,
            )
            for number, (path, i, evidence, square) in enumerate(further)
        ]

    def _simplest(self, evidence: Floats) -> int:
        """Return the term of greatest evidence (k,), or a single variable of the same source with nearly as much."""
        best = int(evidence.argmax())
        source = self.terms[best].source
        if self.terms[best].kind == "single":
            return best
        near = np.flatnonzero(evidence > evidence[best] - _NEARLY).tolist()
        single = [i for i in near if self.terms[i].source is source and self.terms[i].kind == "single"]
        return max(single, key=lambda i: float(evidence[i]), default=best)

    def _fitted(self, path: _Path) -> tuple[Formula, ...]:
        """Return the selected terms with jointly fitted coefficients."""
        if not path.chosen:
            return ()
        terms = [self.terms[i] for i in path.chosen]
        _, columns, length = columns_of(self.projection, terms)
        inverse = np.linalg.inv(columns.T @ columns)
        solved = inverse @ (columns.T @ self.projection.residual)
        sigma = np.sqrt(np.diag(inverse) * path.left / (len(columns) - len(terms)))
        return tuple(
            Formula(term, float(value / unit), float(error / unit), evidence, columns[:, i])
            for i, (term, value, error, unit, evidence) in enumerate(
                zip(terms, solved, sigma, length, path.evidence, strict=True)
            )
        )

    def _products(self, directions: Floats) -> Floats:
        """Return (d, k) products of directions (3 m, d) with all unit columns."""
        if self._kept is not None:
            return directions.T @ self._kept
        parts = chunks(self.terms, len(self.projection.samples))
        return np.hstack([directions.T @ columns_of(self.projection, part)[1] for part in parts])


def _of_shown(columns: Floats, shown: NDArray[np.bool_]) -> Floats:
    """Return the visible columns of (r, k), moved to the front in place, as a copy would double hundreds of MB."""
    for to, at in enumerate(np.flatnonzero(shown).tolist()):
        if to != at:
            columns[:, to] = columns[:, at]
    return columns[:, : int(shown.sum())]


def describe(found: Sequence[Formula], library: str = "not in the library") -> str:
    """Return a formula for every source, with units of the coefficients, followed by a clause about the library.

    Args:
        found: the formulas.
        library: the clause.
    """
    quantities: dict[str, list[str]] = {}
    for f in found:
        unit = f.term.source.coefficient_unit(f.term.variable)
        factor = f"{f.coefficient:.1e}" if unit == "1" else f"{f.coefficient:.1e} ({unit})"
        quantities.setdefault(f.term.source.quantity, []).append(f"{factor} {f.term.variable.text}".strip())
    formulas = [f"{what} = {' + '.join(terms)}" for what, terms in quantities.items()]
    return f"{', '.join(formulas)}; {library}"


def _log_bayes_factor(square: Floats) -> Floats:
    """Return log Bayes factors (k,) of terms with squared scores (k,), averaged over sizes of the coefficient."""
    each = 0.5 * square[:, None] * (_SIZES / (1.0 + _SIZES)) - 0.5 * np.log1p(_SIZES)
    evidence: Floats = logsumexp(each, axis=1) - math.log(len(_SIZES))
    return evidence
