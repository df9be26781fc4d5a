"""How prisms move when the machine's base does."""

from __future__ import annotations

import numpy as np

from calibration.effects.base import Situation
from calibration.observations import Floats

_STEEP = 0.9  # cosine; an axis nearer to the vertical has no level direction to speak of


def base_motion_mm(situation: Situation, amount: Floats) -> Floats:
    """(n, 3, 3) displacement in the station's frame as the base tilts and rises by `amount` (n,).

    About the level axes x and y through the base frame's origin, mm per rad; upwards, mm per mm. Up is against the rig
    file's gravity, and x is the frame's own x axis made level: the frame's axes themselves, where its z axis is up.
    """
    axes = level_axes(situation.rig.gravity)
    place = situation.located.prism_mm
    tilts = [np.cross(axis, place) for axis in axes[:2]]
    moved = np.stack([*tilts, np.tile(axes[2], (len(situation), 1))], axis=2)
    return situation.to_station(moved * amount[:, None, None])


def level_axes(gravity: tuple[float, float, float]) -> Floats:
    """(3, 3) rows: two level axes of the base frame and the one that points up."""
    up = -np.array(gravity) / np.linalg.norm(gravity)
    own = np.eye(3)[0 if abs(up[0]) < _STEEP else 1]
    x = own - (own @ up) * up
    x /= np.linalg.norm(x)
    axes: Floats = np.array([x, np.cross(up, x), up])
    return axes
