"""The terms of the grammar: an error at a source, proportional to one variable or to the product of two."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.gap.formulas.variables import ErrorSource, Variable, Variables
from calibration.gap.projected.projection import Projection
from calibration.observations import Floats

Kind = Literal["single", "crossing", "product"]

_SHARES: Mapping[Kind, float] = {"single": 0.8, "crossing": 0.1, "product": 0.1}  # prior probabilities of the kinds
_SAME = 0.9995  # correlation above which two variables of a source count as the same
_COMPARED = 1500  # number of samples used to compute correlations
_ROUNDING = 1e-9
_AT_ONCE = 2e6  # values in a batch of columns
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Term:
    """A formula of one coefficient.

    Attributes:
        source: source of the error.
        variable: the variable that the error is proportional to.
        kind: `single` for a variable of the source itself, `crossing` for one of a different joint, `product` for two.
        log_prior: log prior probability among all terms.
    """

    source: ErrorSource
    variable: Variable
    kind: Kind
    log_prior: float

    def __str__(self) -> str:
        return f"{self.variable.text} at {self.source.where}"

    @property
    def largest_coefficient(self) -> float:
        """Absolute value of the coefficient beyond which the error in these data would be physically impossible."""
        if math.isinf(self.source.most):
            return math.inf
        return self.source.most / max(float(np.abs(self.variable.values).max(initial=0.0)), _TINY)

    @property
    def moved_mm(self) -> Floats:
        """(m, 3) displacement of the prism per unit of the coefficient, in the station's frame."""
        moved: Floats = self.source.moved_mm * self.variable.values[:, None]
        return moved


def all_terms(variables: Variables) -> tuple[Term, ...]:
    """Return the terms of all sources, without duplicates in these data.

    Single variables share most of the prior probability; variables of other joints and products share the rest.
    """
    found: list[tuple[ErrorSource, Variable, Kind]] = []
    for source in variables.sources():
        words: tuple[tuple[Kind, Iterable[Variable]], ...] = (
            ("single", variables.singles(source)),
            ("crossing", variables.crossings(source)),
            ("product", variables.products(source)),
        )
        own = [(variable, kind) for kind, some in words for variable in some]
        different = (
            _different(np.column_stack([v.values for v, _ in own]), has_offset=source.constant is None) if own else ()
        )
        found += [(source, *own[i]) for i in different]
    count = Counter(kind for _, _, kind in found)
    return tuple(
        Term(source, variable, kind, math.log(_SHARES[kind] / count[kind])) for source, variable, kind in found
    )


def modulations(projection: Projection, source: ErrorSource) -> tuple[Term, ...]:
    """Return an error of known pattern multiplied by each of the variables that its size may depend on.

    Each variable is offset so that the product is orthogonal to the error itself. This is because the fitted size is
    shrunk by its prior, so that residuals always retain a part proportional to the error.

    Args:
        projection: projection at the fit.
        source: the error.
    """
    every = Variables(projection).conditions(source.where)
    own = [every[i] for i in _different(np.column_stack([v.values for v in every]), has_offset=True)]
    values = np.column_stack([np.ones(len(source.moved_mm)), *(v.values for v in own)])
    itself, *products = projection.columns(source.moved_mm[:, :, None] * values[:, None]).T
    square = max(float(itself @ itself), _TINY)
    about = [replace(v, values=v.values - product @ itself / square) for v, product in zip(own, products, strict=True)]
    return tuple(Term(source, variable, "single", -math.log(len(about))) for variable in about)


def _different(values: Floats, *, has_offset: bool) -> list[int]:
    """Return the indices of columns of (m, k) that do not repeat an earlier one, nor a constant if `has_offset`."""
    values = values[:: max(len(values) // _COMPARED, 1)]
    least = _ROUNDING * np.linalg.norm(values, axis=0)
    values = values - values.mean(axis=0) if has_offset else values
    length = np.linalg.norm(values, axis=0)
    varies = length > least
    unit = values / np.where(varies, length, 1.0)
    same = np.triu(np.abs(unit.T @ unit) > _SAME, 1).any(axis=0)
    different: list[int] = np.flatnonzero(varies & ~same).tolist()
    return different


def chunks(terms: Sequence[Term], samples: int) -> Iterator[Sequence[Term]]:
    """Yield the terms in batches whose columns fit into the memory of a small computer.

    Args:
        terms: the terms.
        samples: number of samples.
    """
    step = max(int(_AT_ONCE) // (3 * samples), 1)
    for start in range(0, len(terms), step):
        yield terms[start : start + step]


def columns_of(projection: Projection, terms: Sequence[Term]) -> tuple[Floats, Floats, Floats]:
    """Return displacements (m, 3, k) of terms, mm, unit columns (3 m, k) in the projected space, and lengths (k,)."""
    moved = np.stack([term.moved_mm for term in terms], axis=2)
    columns = projection.columns(moved)
    length = np.linalg.norm(columns, axis=0)
    return moved, columns / np.maximum(length, _TINY), length
