"""The machine by plain 4x4 matrices multiplied row by row: independent of the simulator's product of exponentials."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simulators.rig.truth import RigTruth

Matrix = NDArray[np.float64]


def turn(axis: int, angle: float) -> Matrix:
    c, s = np.cos(angle), np.sin(angle)
    out = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[i, i], out[i, j], out[j, i], out[j, j] = c, -s, s, c
    return out


def move(axis: int, length: float) -> Matrix:
    out = np.eye(4)
    out[axis, 3] = length
    return out


def frames_by_matrices(truth: RigTruth, joints: dict[str, float]) -> list[Matrix]:
    """Frame 0, 1, ... in the base frame, by the conventions as calibration/rig/description.py words them."""
    rig = truth.rig
    value = {j.name: np.deg2rad(joints[j.name]) if j.kind == "revolute" else joints[j.name] for j in rig.joints}
    out = [np.eye(4)]
    for row, own in zip(rig.rows, truth.constants, strict=True):
        T = out[-1] if row.after is None else out[row.after]
        driven = {k: sum(c * value[n] for n, c in combination.items()) for k, combination in row.drive.items()}
        a, d, theta = own.a + driven.get("a", 0), own.d + driven.get("d", 0), own.theta + driven.get("theta", 0)
        if row.before is not None:
            f = row.before
            T = T @ move(0, f.x_mm) @ move(1, f.y_mm) @ move(2, f.z_mm)
            T = T @ turn(2, np.deg2rad(f.rz_deg)) @ turn(1, np.deg2rad(f.ry_deg)) @ turn(0, np.deg2rad(f.rx_deg))
        if rig.convention == "mdh_beta_after":
            T = T @ move(0, a) @ turn(0, own.alpha) @ move(2, d) @ turn(2, theta) @ turn(1, own.beta)
        elif rig.convention == "mdh_beta_before":
            T = T @ turn(0, own.alpha) @ move(0, a) @ turn(1, own.beta) @ move(1, own.b) @ turn(2, theta) @ move(2, d)
        else:
            T = T @ turn(2, theta) @ move(2, d) @ move(0, a) @ turn(0, own.alpha) @ turn(1, own.beta)
        out.append(T)
    return out


def positions_by_matrices(truth: RigTruth, prism: str, joints: dict[str, Matrix], setup: str = "") -> Matrix:
    place = truth.placement(setup)
    frame = truth.rig.prism(prism).frame
    n = len(next(iter(joints.values())))
    out = np.empty((n, 3))
    for i in range(n):
        T = frames_by_matrices(truth, {k: float(v[i]) for k, v in joints.items()})[frame]
        base = T[:3, :3] @ truth.prism_offset_mm(prism) + T[:3, 3]
        out[i] = place.rotation @ base + place.position_mm
    return out
