"""Pose plans as they occur: spread over the work volume, drilling a face, or a few clusters."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig
from simulators.dataset import random_poses
from simulators.screws import Posture, ScrewChain, nominal_constants, pose_chain, screw_chain

Floats = NDArray[np.float64]
PosePlan = Literal["wide", "face", "sparse"]

_FACE_SHARE = 0.45  # of a revolute joint's range, about its middle, before the feed is set parallel
_FACE_ROUNDS = 3
_FACE_JITTER_DEG = 0.5  # an operator sets the feed parallel by eye and by angle display
_POSES_A_CLUSTER = 6
_CLUSTER_SHARE = 0.04  # of a joint's range, 1 sigma


def draw_poses(rig: Rig, plan: PosePlan, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Poses within the joint limits.

    Args:
        rig: gives joints and limits.
        plan: `wide`, evenly between the limits; `face`, the last frame's z axis (the feed) held parallel to one
            direction as a drill plan asks, so that joints move little and make up for one another; `sparse`, a few
            clusters of poses that are nearly the same.
        n: how many.
        rng: source.

    Returns:
        Joint name -> (n,) deg or mm.
    """
    if plan == "wide":
        return random_poses(rig, n, rng)
    if plan == "face":
        return _face(rig, n, rng)
    centres = random_poses(rig, max(4, -(-n // _POSES_A_CLUSTER)), rng)
    which = rng.integers(len(next(iter(centres.values()))), size=n)
    spread = {j.name: _CLUSTER_SHARE * (j.limits[1] - j.limits[0]) for j in rig.joints}
    return _within(rig, {k: v[which] + rng.normal(0.0, spread[k], n) for k, v in centres.items()})


def _face(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    chain = screw_chain(rig, nominal_constants(rig))
    turning = [j for j in rig.joints if j.kind == "revolute"]
    span = np.deg2rad([j.limits[1] - j.limits[0] for j in turning])
    middle = {j.name: np.array([sum(j.limits) / 2]) for j in rig.joints}
    feed = pose_chain(chain, _radians(rig, middle)).axes(len(rig.rows))[0, :, 2]
    poses = random_poses(rig, n, rng)
    for joint in turning:
        poses[joint.name] = middle[joint.name] + _FACE_SHARE * (poses[joint.name] - middle[joint.name])
    for _ in range(_FACE_ROUNDS):
        posture = pose_chain(chain, _radians(rig, poses))
        axis = posture.axes(len(rig.rows))[:, :, 2]
        turns = _turn_axes(chain, posture, [j.name for j in turning], len(rig.rows))
        across = turns - axis[:, :, None] * (axis[:, None, :] @ turns)
        missing = np.cross(axis, feed)
        # Every joint takes a share by its range: least squares in units of the ranges.
        weighted = across * span**2
        normal = weighted @ across.transpose(0, 2, 1) + 1e-6 * np.eye(3)
        step = (weighted.transpose(0, 2, 1) @ np.linalg.solve(normal, missing[:, :, None]))[:, :, 0]
        for i, joint in enumerate(turning):
            poses[joint.name] = poses[joint.name] + np.rad2deg(step[:, i])
        poses = _within(rig, poses)
    for joint in turning:
        poses[joint.name] = poses[joint.name] + rng.normal(0.0, _FACE_JITTER_DEG, n)
    return _within(rig, poses)


def _turn_axes(chain: ScrewChain, posture: Posture, joints: list[str], frame: int) -> Floats:
    """(n, 3, joints) by which rotation vector a frame turns per radian of each joint."""
    out = np.zeros((len(posture.rotations[0]), 3, len(joints)))
    for index, screw in enumerate(chain.screws):
        if screw.turns and chain.carries(index, frame):
            axis, _ = posture.axis(index)
            for i, joint in enumerate(joints):
                if joint in screw.weights:
                    out[:, :, i] += screw.weights[joint] * axis
    return out


def _radians(rig: Rig, poses: dict[str, Floats]) -> dict[str, Floats]:
    return {j.name: np.deg2rad(poses[j.name]) if j.kind == "revolute" else poses[j.name] for j in rig.joints}


def _within(rig: Rig, poses: dict[str, Floats]) -> dict[str, Floats]:
    return {j.name: np.clip(poses[j.name], *j.limits) for j in rig.joints}
