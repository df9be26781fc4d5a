"""Readings and the limits of their joints: which whole turns change nothing, and what lies beyond."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Joint, Rig

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_TURN_DEG = 360.0
_SLACK = 0.05  # of a joint's range: a zero or a limit of the file may be off by so much
_IMMOBILE = 0.01  # of the same: less is no motion


def turns_deg(rig: Rig) -> Floats:
    """Return (joints,): 360 for joints whose whole turns leave the machine where it is, else 0.

    That is so of a revolute joint that turns rows by whole multiples; behind a gear, or where an angle drives a length,
    a turn is another place.
    """
    lasting = {
        name for _, driven, name, coefficient in rig.couplings() if driven != "theta" or not coefficient.is_integer()
    }
    return np.array(
        [_TURN_DEG if joint.kind == "revolute" and joint.name not in lasting else 0.0 for joint in rig.joints]
    )


def on_one_turn(rig: Rig, joints: Mapping[str, Floats]) -> dict[str, Floats]:
    """Bring readings, recorded on any turn of their encoders, to the turn inside the limits of their joints.

    Readings that no whole turn brings there stay as they were: those of an encoder that is turned or reversed still
    belong together.

    Args:
        rig: the machine.
        joints: joint -> (n,) deg or mm.
    """
    found = dict(joints)
    for joint, turn in zip(rig.joints, turns_deg(rig).tolist(), strict=True):
        if turn > 0.0:
            values = found[joint.name]
            near = values - turn * np.rint((values - sum(joint.limits) / 2.0) / turn)
            moved = beyond_limits(joint, values, 0.0) & ~beyond_limits(joint, near, _SLACK)
            found[joint.name] = np.where(moved, near, values)
    return found


def beyond_limits(joint: Joint, values: Floats, share: float) -> Flags:
    """Return an (n,) mask of values, deg or mm, beyond the joint's limits by more than a share of their range."""
    low, high = joint.limits
    margin = share * (high - low)
    return np.asarray((values < low - margin) | (values > high + margin))


def never_moved(joint: Joint, low: float, high: float) -> bool:
    """Return True if readings from `low` to `high`, deg or mm, are of a joint that stood still."""
    return high - low < _IMMOBILE * (joint.limits[1] - joint.limits[0])
