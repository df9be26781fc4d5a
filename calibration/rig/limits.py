"""Joint readings and joint limits: removal of whole turns, and detection of values beyond the limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Joint, Rig

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_TURN_DEG = 360.0
_SLACK = 0.05  # of a joint's range: tolerated error of a zero or a limit in the file
_IMMOBILE = 0.01  # of a joint's range: a smaller range of readings is not a motion


def turns_deg(rig: Rig) -> Floats:
    """Return (joints,): 360 for each joint whose whole turns do not change the machine's pose, else 0.

    These are the revolute joints that drive only angles, with whole-number coefficients. With a gear, or if the angle
    drives a length, a whole turn changes the pose.
    """
    lasting = {
        name for _, driven, name, coefficient in rig.couplings() if driven != "theta" or not coefficient.is_integer()
    }
    return np.array(
        [_TURN_DEG if joint.kind == "revolute" and joint.name not in lasting else 0.0 for joint in rig.joints]
    )


def on_one_turn(rig: Rig, joints: Mapping[str, Floats]) -> dict[str, Floats]:
    """Shift readings, recorded on any turn of their encoders, by whole turns into the limits of their joints.

    Readings that no whole turn brings inside the limits are unchanged, so that the readings of an encoder that is
    mounted turned or reversed remain consistent.

    Args:
        rig: the machine.
        joints: joint -> (n,) readings, deg or mm.

    Returns:
        joint -> (n,) readings on the turn of the limits.
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
    """Return an (n,) mask of values, deg or mm, beyond the joint's limits by more than `share` of their range."""
    low, high = joint.limits
    margin = share * (high - low)
    return np.asarray((values < low - margin) | (values > high + margin))


def never_moved(joint: Joint, low: float, high: float) -> bool:
    """Return True if readings between `low` and `high`, deg or mm, mean that the joint did not move."""
    return high - low < _IMMOBILE * (joint.limits[1] - joint.limits[0])
