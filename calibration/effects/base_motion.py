"""How prisms move when the machine's base does."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Situation
from calibration.observations import Floats


def base_motion_mm(situation: Situation, amount: Floats) -> Floats:
    """(n, 3, 3) displacement in the station's frame as the base tilts and rises by `amount` (n,).

    About the base frame's x axis and its y axis through its origin, mm per rad; along its z axis, mm per mm.
    """
    x, y, z = situation.located.prism_mm.T
    none, one = np.zeros(len(situation)), np.ones(len(situation))
    moved = np.array([[none, z, none], [-z, none, none], [y, -x, one]]).transpose(2, 0, 1)
    return situation.to_station(moved * amount[:, None, None])
