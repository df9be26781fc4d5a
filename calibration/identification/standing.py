"""When a joint stood still: its readings differ by no more than their own random errors."""

from __future__ import annotations

import numpy as np

from calibration.observations import Floats
from calibration.rig import Rig

_SPREAD = 10.0  # sigma between the lowest and the highest of some thousand readings of one value


def standing_spread(rig: Rig) -> Floats:
    """(joints,) largest difference of two readings of a joint that did not move, deg or mm."""
    return np.array([_SPREAD * joint.sigma + 2.0 * joint.resolution for joint in rig.joints])
