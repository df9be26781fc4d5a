"""Sparse storage for columns of curves, which are mostly zero and would take most of the memory of all candidates."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from calibration.effects.columns import EffectColumns, Integers
from calibration.observations import Floats

_RARE = 0.25  # largest share of nonzero values for sparse storage


class RareColumns(EffectColumns):
    """Coefficients at a joint with sparse columns.

    Args:
        names, joint, prior_sigma: as for `EffectColumns`.
        column: as for `EffectColumns`, dense or sparse.
        shift_mm: None.

    Attributes:
        sparse: (m, k) the columns.
    """

    sparse: csr_array

    def __init__(
        self, names: tuple[str, ...], joint: Integers, column: Floats | csr_array, prior_sigma: Floats, shift_mm: None
    ) -> None:
        sparse = column if isinstance(column, csr_array) else csr_array(column)
        kept = {"names": names, "joint": joint, "sparse": sparse, "prior_sigma": prior_sigma, "shift_mm": shift_mm}
        for name, value in kept.items():
            object.__setattr__(self, name, value)

    @property
    def column(self) -> Floats:
        """(m, k) dense columns, deg or mm; computed on each access."""
        dense: Floats = self.sparse.toarray()
        return dense

    @property
    def rows(self) -> int:
        """Number of rows m."""
        return int(self.sparse.shape[0])

    @cached_property
    def sums(self) -> tuple[int, float, float]:
        """As of `EffectColumns`."""
        return len(self), float(self.sparse.sum()), 0.0

    def has_columns_of(self, other: EffectColumns) -> bool:
        """As of `EffectColumns`."""
        return isinstance(other, RareColumns) and self.sparse is other.sparse

    def with_columns_of(self, other: EffectColumns) -> EffectColumns:
        """As of `EffectColumns`."""
        column = other.sparse if isinstance(other, RareColumns) else other.column
        return RareColumns(self.names, self.joint, column, self.prior_sigma, None)


def without_zeros(columns: EffectColumns) -> EffectColumns:
    """Return the same coefficients with sparse columns, if all are at one joint and most values are zero."""
    is_at_joint = columns.shift_mm is None and len(set(columns.joint.tolist())) == 1
    if not is_at_joint or np.count_nonzero(columns.column) > _RARE * columns.column.size:
        return columns
    return RareColumns(columns.names, columns.joint, columns.column, columns.prior_sigma, None)
