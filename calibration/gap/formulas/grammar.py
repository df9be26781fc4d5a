"""Formulas for what is in no library, as the data ask for them.

Each term is a single column in the projected space, and its evidence is that of a coefficient whose order of magnitude
nobody knows: the mean of the closed form of `projection.from_products` over prior sigmas from one standard error up
to what would be plain to see. Several terms are found one after the other, each in what those before it leave
(orthogonal matching pursuit: Pati, Rezaiifar and Krishnaprasad, Asilomar 1993), from several beginnings: where an error
has two terms, as a wave of any phase has, a third may look like both and beat each alone.
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
from calibration.gap.projection import Projection, SoftProjection
from calibration.observations import Floats

_LEAST_SEEN = 1e-3  # visible share of a term's displacement, of the largest such share; less is rounding
_SIZES = 4.0 ** np.arange(1, 13)  # prior sigma^2 in standard errors^2
_KEPT = 1e7  # numbers that are kept for the next question
_BLOCKS = 1000  # of groups, for the sums by group
_MOST = 3  # terms of a description
_BEGINNINGS = 12
_WORTH = math.log(99.0)  # odds for a term, to be in it
_NEARLY = math.log(10.0)
_LEAST_OWN = 1e-3  # share of a term's square that those before it do not have
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Formula:
    """A term that the data ask for.

    Attributes:
        term: which.
        coefficient, standard_error: in the unit of `term.source.coefficient_unit(term.variable)`, all found terms
            together.
        log_evidence: ln of the Bayes factor against what was there before it, the odds among all terms in it.
        column: (3 m,) what it moves in the projected space, of length 1.
    """

    term: Term
    coefficient: float
    standard_error: float
    log_evidence: float
    column: Floats

    def adds_to(self, columns: Floats, residual: Floats) -> bool:
        """True if the data ask for the term in addition to an effect, by what the effect does not explain.

        Args:
            columns: (3 m, k) of the effect in the projected space, of one prior sigma each.
            residual: (3 m,) there.
        """
        without_effect = SoftProjection(columns)
        column = without_effect(self.column)
        square = (column @ without_effect(residual)) ** 2 / max(float(column @ column), _TINY)
        return bool(_log_bayes_factor(np.array([square]))[0] > _WORTH)


@dataclass(frozen=True)
class _Path:
    """Terms chosen one after the other.

    Attributes:
        chosen: indices of the terms.
        evidence: log evidence of each when it was chosen.
        odds: of the choice beforehand and for the sizes that the coefficients might have had, logarithm.
        basis: (3 m, j) orthonormal, of the columns chosen.
        overlap: (j, k) of all unit columns with it.
        left: squares that are left of the residual.
    """

    chosen: tuple[int, ...]
    evidence: tuple[float, ...]
    odds: float
    basis: Floats
    overlap: Floats
    left: float

    def value(self, noise: float) -> float:
        """Return the log evidence of the terms together, which may lower the noise from what it was taken for."""
        if self.left > noise:
            return self.odds - 0.5 * self.left
        return self.odds - 0.5 * noise * (1.0 + math.log(max(self.left, _TINY) / noise))


class Grammar:
    """Terms of which formulas are made, in the projected space, and how they fit.

    Args:
        projection: the fit.
        possible: terms; all that may be off by default.

    Attributes:
        projection: the same.
        terms: (k) those that these data show and tell apart.
        score: (k,) of each, a standard normal number if nothing is missing.
        by_group: (blocks, k) parts of the scores by groups of samples that no fold separates.
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
        """Return the terms that the data ask for together, the strongest first; none if all may be chance.

        Args:
            most: terms.
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
        """Return (k,) squared scores of all terms in what a path leaves, and (k,) their log evidence."""
        # What the terms before it explain was noise to them, but is none to the next one.
        scale = min(1.0, path.left / noise)
        own = 1.0 - (path.overlap**2).sum(axis=0)
        score = self.score - path.overlap.T @ (path.basis.T @ self.projection.residual)
        coefficient = score / np.maximum(own, _LEAST_OWN)
        is_possible = (own > _LEAST_OWN) & (np.abs(coefficient) <= self._largest)
        square = np.where(is_possible, score * coefficient / scale, 0.0)
        return square, _log_bayes_factor(square) + self._prior

    def _extended(self, further: Sequence[tuple[_Path, int, float, float]]) -> list[_Path]:
        """Return the paths with one more term each, which is given with its log evidence and squared score."""
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
        """Return the term of the greatest evidence (k,), or a single variable of its source with nearly as much."""
        best = int(evidence.argmax())
        source = self.terms[best].source
        if self.terms[best].kind == "single":
            return best
        near = np.flatnonzero(evidence > evidence[best] - _NEARLY).tolist()
        single = [i for i in near if self.terms[i].source is source and self.terms[i].kind == "single"]
        return max(single, key=lambda i: float(evidence[i]), default=best)

    def _fitted(self, path: _Path) -> tuple[Formula, ...]:
        """Return the chosen terms with coefficients fitted together."""
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
    """Return the columns (r, k) that are shown, moved to the front in place: a copy would double hundreds of MB."""
    for to, at in enumerate(np.flatnonzero(shown).tolist()):
        if to != at:
            columns[:, to] = columns[:, at]
    return columns[:, : int(shown.sum())]


def describe(found: Sequence[Formula], library: str = "not in the library") -> str:
    """Return a formula for every source, coefficients with their units, then what the library says, a clause."""
    quantities: dict[str, list[str]] = {}
    for f in found:
        unit = f.term.source.coefficient_unit(f.term.variable)
        factor = f"{f.coefficient:.1e}" if unit == "1" else f"{f.coefficient:.1e} ({unit})"
        quantities.setdefault(f.term.source.quantity, []).append(f"{factor} {f.term.variable.text}".strip())
    formulas = [f"{what} = {' + '.join(terms)}" for what, terms in quantities.items()]
    return f"{', '.join(formulas)}; {library}"


def _log_bayes_factor(square: Floats) -> Floats:
    """Return (k,) log Bayes factors of terms with squared scores (k,), for sizes of any order of magnitude."""
    each = 0.5 * square[:, None] * (_SIZES / (1.0 + _SIZES)) - 0.5 * np.log1p(_SIZES)
    evidence: Floats = logsumexp(each, axis=1) - math.log(len(_SIZES))
    return evidence
