"""When a joint stood still, and where it stopped: readings of one stop differ by no more than their random errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.rig import Rig

Integers = NDArray[np.intp]

LEAST_STOPS = 5  # of a joint that is swept while others stand

_SPREAD = 10.0  # sigma between the lowest and the highest of some thousand readings of one value


def standing_spread(rig: Rig) -> Floats:
    """(joints,) largest difference of two readings of a joint that did not move, deg or mm."""
    return np.array([_SPREAD * joint.sigma + 2.0 * joint.resolution for joint in rig.joints])


def stops(readings: Floats, spread: float) -> Integers:
    """(n,) number of the stop, from 0, that each of the rising readings (n,) of a joint belongs to.

    `spread` is that joint's `standing_spread`.
    """
    out = np.zeros(len(readings), dtype=np.intp)
    first = readings[0]
    for i in range(1, len(readings)):
        new = readings[i] - first > spread
        first = readings[i] if new else first
        out[i] = out[i - 1] + new
    return out
