"""How fast the prisms move at the instants of their fixes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.effects.base import Situation
from calibration.observations import Floats


def velocity_mm_per_s(situation: Situation) -> Floats:
    """(n, 3) velocity of the prism in the station's frame; a joint whose rate is not measured stands."""
    rates = np.column_stack([situation.extra(f"{name}_rate") for name in situation.rig.joint_names])
    moved = situation.located.joint_jacobian @ np.nan_to_num(rates)[:, :, None]
    return situation.to_station(moved)[:, :, 0]


def has_rates(situation: Situation) -> NDArray[np.bool_]:
    """(n,) whether the rates of the rows' joints are recorded; an empty cell beside others is a joint that stands."""
    columns = (f"{name}_rate" for name in situation.rig.joint_names)
    return np.full(len(situation), any(column in situation.observations.extra for column in columns))
