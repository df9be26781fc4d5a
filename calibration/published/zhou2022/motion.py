"""Which fixes belong to single-joint motion, and which of them to one standstill."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibration.identification.standing import LEAST_STOPS, standing_spread, stops
from calibration.observations import Observations
from calibration.rig import Rig

Flags = NDArray[np.bool_]
Integers = NDArray[np.intp]


def single_joint_rows(rig: Rig, observations: Observations) -> Flags:
    """(n,) which rows were measured while one joint alone was moved from stop to stop.

    A row does if there is a joint for which at least five different readings, its own among them, were taken at its
    set-up while every other joint stood still. That is of all joints, and of every row's own neighbours: the sweeps of
    `find_axes` ask for those alone that move the prism, and share no row.
    """
    found = np.zeros(len(observations), dtype=bool)
    scaled = np.column_stack([observations.joints[name] for name in rig.joint_names]) / standing_spread(rig)
    for setup in np.unique(observations.setup):
        rows = np.flatnonzero(observations.setup == setup)
        poses, of_row = np.unique(scaled[rows], axis=0, return_inverse=True)
        swept = np.zeros(len(poses), dtype=bool)
        for joint in range(len(rig.joints)):
            others = np.delete(poses, joint, axis=1)
            if others.shape[1] == 0:
                others = np.zeros((len(poses), 1))
            near = cKDTree(others).query_ball_point(others, 1.0, p=np.inf)
            swept |= np.array([stops(np.sort(poses[group, joint]), 1.0)[-1] + 1 >= LEAST_STOPS for group in near])
        found[rows] = swept[of_row]
    return found


def standstills(observations: Observations) -> Integers:
    """(n,) number of the standstill of every row: those of one session, set-up and pose, or else a row by itself."""
    seen: dict[tuple[str, str, str], int] = {}
    numbers = np.empty(len(observations), dtype=np.intp)
    labels = zip(observations.session.tolist(), observations.setup.tolist(), observations.pose.tolist(), strict=True)
    for row, label in enumerate(labels):
        numbers[row] = seen.setdefault(label, row) if label[2] else row
    return numbers
