"""Along which line the station sees each prism, and which rows are of which prism."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Situation
from calibration.observations import Floats

_LEAST_MM = 1e-6


def sight(situation: Situation) -> Floats:
    """(n, 3) unit vectors from the instrument's centre to the prism, in the station's frame."""
    position_mm = situation.located.position_mm
    range_mm = np.sqrt((position_mm**2).sum(axis=1))
    lines: Floats = position_mm / np.maximum(range_mm, _LEAST_MM)[:, None]
    return lines


def of_prism(situation: Situation, prism: str) -> NDArray[np.bool_]:
    """(n,) rows of one prism."""
    rows: NDArray[np.bool_] = situation.data.prism == situation.rig.prism_names.index(prism)
    return rows
