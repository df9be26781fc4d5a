"""The field's incumbent: a table of stored corrections, one for each cell of boom reach and direction.

The correction of a cell is the mean error of the fixes in it. Cells are as a contractor lays them out: rings of a tenth
of the longest reach, sectors of 15 degrees, and one table for each point of the boom. A cell without a fix has no
correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.residual.features import Features

_RINGS = 10
_SECTORS = 24
_HORIZONTAL = ("prism_x_mm", "prism_y_mm")


@dataclass(frozen=True)
class CorrectionTable:
    """The table of one prism.

    Attributes:
        ring_mm: width of a ring.
        correction_mm: (rings + 1, sectors, 3) in the base frame; zero where nothing was measured, and beyond all rings.
    """

    ring_mm: float
    correction_mm: Floats

    @classmethod
    def fit(cls, features: Features, target_mm: Floats) -> Self:
        """Average the errors in each cell.

        Args:
            features: n rows of one prism.
            target_mm: (n, 3) residuals in the base frame.
        """
        reach_mm = np.hypot(*features.columns(_HORIZONTAL).T)
        ring_mm = max(float(reach_mm.max()), 1.0) * (1.0 + 1e-9) / _RINGS  # the longest is inside
        cell = np.ravel_multi_index(_cells(features, ring_mm), (_RINGS + 1, _SECTORS))
        cells = (_RINGS + 1) * _SECTORS
        fixes = np.maximum(np.bincount(cell, minlength=cells), 1)
        total = np.column_stack([np.bincount(cell, column, cells) for column in target_mm.T])
        return cls(ring_mm, (total / fixes[:, None]).reshape(_RINGS + 1, _SECTORS, 3))

    def predict(self, features: Features) -> Floats:
        """(n, 3) correction in the base frame, mm."""
        ring, sector = _cells(features, self.ring_mm)
        inside = (ring < _RINGS)[:, None]
        return np.where(inside, self.correction_mm[ring, sector], 0.0)


def _cells(features: Features, ring_mm: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ring and sector of every row; all that is beyond the rings is in one more."""
    x, y = features.columns(_HORIZONTAL).T
    ring = np.minimum(np.hypot(x, y) // ring_mm, _RINGS).astype(np.intp)
    sector = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    return ring, sector
