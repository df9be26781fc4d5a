"""A part of the rows that stands for all of them: enough of every set-up to place its base."""

from __future__ import annotations

import numpy as np

from calibration.identification.start import on_a_line
from calibration.kinematics import ChainData, Integers
from calibration.observations import Floats

_LEAST = 6  # rows of a set-up


def drawn(data: ChainData, position_mm: Floats, count: int, seed: int) -> Integers:
    """Rising numbers of about `count` rows, drawn at random.

    A set-up with too few of them, or with all of them on a line, gets more, so that no base is left to chance: `_LEAST`
    rows and two dimensions, as far as it has them.

    Args:
        data, position_mm: n rows.
        count: of rows; all are taken where there are no more.
        seed: of the draw.
    """
    order = np.random.default_rng(seed).permutation(len(data))
    taken = np.zeros(len(data), dtype=bool)
    taken[order[:count]] = True
    for setup in np.unique(data.setup):
        own = order[data.setup[order] == setup]
        number = max(int(taken[own].sum()), min(_LEAST, len(own)))
        while number < len(own) and on_a_line(position_mm[own[:number]]):
            number += 1
        taken[own[:number]] = True
    return np.flatnonzero(taken)
