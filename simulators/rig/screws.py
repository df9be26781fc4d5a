"""Kinematics as a product of exponentials: home screws and home frames, derived from a rig's rows.

A row is a chain of elementary transforms. A transform that a joint drives becomes a screw in the base frame at home
(all joint values zero):

    T_f(q) = exp(S_1 m_1) ... exp(S_k m_k) M_f,   m_i = sum over joints of coefficient * joint value

with the product over the motions that carry frame f. Lengths are mm, angles rad. (Lynch & Park, Modern Robotics, ch. 4)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Convention, FixedTransform, Rig

Floats = NDArray[np.float64]

_AXES = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0])}

# Elementary transforms of a row, in order: (kind, axis, name of the row's constant)
_ORDER: Mapping[Convention, Sequence[tuple[str, str, str]]] = {
    "mdh_beta_after": (
        ("move", "x", "a"),
        ("turn", "x", "alpha"),
        ("move", "z", "d"),
        ("turn", "z", "theta"),
        ("turn", "y", "beta"),
    ),
    "mdh_beta_before": (
        ("turn", "x", "alpha"),
        ("move", "x", "a"),
        ("turn", "y", "beta"),
        ("move", "y", "b"),
        ("turn", "z", "theta"),
        ("move", "z", "d"),
    ),
    "dh": (
        ("turn", "z", "theta"),
        ("move", "z", "d"),
        ("move", "x", "a"),
        ("turn", "x", "alpha"),
        ("turn", "y", "beta"),
    ),
}


@dataclass(frozen=True)
class RowConstants:
    """A row's constants in rad and mm."""

    alpha: float
    a: float
    d: float
    theta: float
    beta: float
    b: float


@dataclass(frozen=True)
class Screw:
    """One driven motion, in the base frame at home.

    Attributes:
        row: number of its row, from 1.
        turns: True for a rotation about `axis` through `point_mm`, False for a translation along `axis`.
        axis: (3,) unit vector.
        point_mm: (3,) a point on the axis.
        weights: joint name -> rad or mm of the motion per rad or mm of the joint's value.
        start: (4, 4) home pose of the frame in which the motion acts; a driven length begins at its origin.
        before: number of the motion that carries this one, from 1; 0 if there is none. Rows may branch.
    """

    row: int
    turns: bool
    axis: Floats
    point_mm: Floats
    weights: Mapping[str, float]
    start: Floats
    before: int


@dataclass(frozen=True)
class ScrewChain:
    """A machine's screws in chain order and the home poses of its frames (frame 0 is the base).

    Attributes:
        screws: the driven motions.
        homes: (rows + 1) x (4, 4) home poses.
        last_screw: for each frame the number of the last motion that carries it, from 1; 0 if there is none.
    """

    screws: tuple[Screw, ...]
    homes: tuple[Floats, ...]
    last_screw: tuple[int, ...]

    def carries(self, screw: int, frame: int) -> bool:
        """Return True if motion number `screw` (from 0) moves a frame."""
        motion = self.last_screw[frame]
        while motion > screw + 1:
            motion = self.screws[motion - 1].before
        return motion == screw + 1


def nominal_constants(rig: Rig) -> tuple[RowConstants, ...]:
    """Return the constants of every row from the rig file, in rad and mm."""
    deg = np.pi / 180
    return tuple(
        RowConstants(r.alpha_deg * deg, r.a_mm, r.d_mm, r.theta_deg * deg, r.beta_deg * deg, r.b_mm) for r in rig.rows
    )


def rotation(axis: Floats, angle: Floats) -> Floats:
    """Return (n, 3, 3) rotations about a (3,) unit vector or (n, 3) unit vectors by (n,) angles in rad (Rodrigues)."""
    axis = np.broadcast_to(axis, (len(angle), 3))
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    s, c = np.sin(angle), np.cos(angle)
    v = 1.0 - c
    out = np.empty((len(angle), 3, 3))
    out[:, 0, 0] = c + x * x * v
    out[:, 0, 1] = x * y * v - z * s
    out[:, 0, 2] = x * z * v + y * s
    out[:, 1, 0] = x * y * v + z * s
    out[:, 1, 1] = c + y * y * v
    out[:, 1, 2] = y * z * v - x * s
    out[:, 2, 0] = x * z * v - y * s
    out[:, 2, 1] = y * z * v + x * s
    out[:, 2, 2] = c + z * z * v
    return out


def rotation_by_vector(vector: Floats) -> Floats:
    """Return (n, 3, 3) rotations by (n, 3) rotation vectors: the direction is the axis, the length the angle in rad."""
    angle = np.linalg.norm(vector, axis=1)
    axis = vector / np.where(angle > 0, angle, 1.0)[:, None]
    return rotation(axis, angle)


def _elementary(kind: str, axis: str, value: float) -> Floats:
    out = np.eye(4)
    if kind == "move":
        out[:3, 3] = value * _AXES[axis]
    else:
        out[:3, :3] = rotation(_AXES[axis], np.array([value]))[0]
    return out


def _fixed(before: FixedTransform) -> Floats:
    out = np.eye(4)
    out[:3, 3] = before.x_mm, before.y_mm, before.z_mm
    for axis, degrees in (("z", before.rz_deg), ("y", before.ry_deg), ("x", before.rx_deg)):
        out = out @ _elementary("turn", axis, np.deg2rad(degrees))
    return out


def screw_chain(rig: Rig, constants: Sequence[RowConstants]) -> ScrewChain:
    """Return the home screws and frames of a machine with given constants.

    Args:
        rig: description with the order of the elementary transforms in a row, the fixed transforms and the joints that
            drive each row; the constants of its rows are not used.
        constants: constants of the machine, one per row.
    """
    radians = {joint.name: np.pi / 180 if joint.kind == "revolute" else 1.0 for joint in rig.joints}
    screws: list[Screw] = []
    homes = [np.eye(4)]
    last = [0]
    for number, (row, own) in enumerate(zip(rig.rows, constants, strict=True), 1):
        origin = number - 1 if row.after is None else row.after
        pose, motion = homes[origin], last[origin]
        if row.before is not None:
            pose = pose @ _fixed(row.before)
        driven: Mapping[str, Mapping[str, float]] = {str(k): v for k, v in row.drive.items()}
        for kind, axis, name in _ORDER[rig.convention]:
            if name in driven:
                direction = pose[:3, :3] @ _AXES[axis]
                point = pose[:3, 3].copy()
                # A rig file uses deg and mm
                unit = np.pi / 180 if kind == "turn" else 1.0
                weights = {joint: float(c * (unit / radians[joint])) for joint, c in driven[name].items()}
                screws.append(Screw(number, kind == "turn", direction, point, weights, pose.copy(), motion))
                motion = len(screws)
            pose = pose @ _elementary(kind, axis, getattr(own, name))
        homes.append(pose.copy())
        last.append(motion)
    return ScrewChain(tuple(screws), tuple(homes), tuple(last))


@dataclass
class Posture:
    """A chain at n sets of joint values.

    Attributes:
        chain: the machine.
        rotations, shifts_mm: first the identity, then for each motion the product of its exponential and those of all
            motions that carry it, (n, 3, 3) and (n, 3).
    """

    chain: ScrewChain
    rotations: list[Floats] = field(default_factory=list)
    shifts_mm: list[Floats] = field(default_factory=list)

    def point_mm(self, frame: int, place_mm: Floats) -> Floats:
        """Return the (n, 3) position in the base frame of a point fixed to `frame` at (3,) `place_mm`."""
        home = self.chain.homes[frame]
        at_home = home[:3, :3] @ place_mm + home[:3, 3]
        k = self.chain.last_screw[frame]
        moved: Floats = self.rotations[k] @ at_home + self.shifts_mm[k]
        return moved

    def axes(self, frame: int) -> Floats:
        """Return the (n, 3, 3) axes of `frame` as columns, in the base frame."""
        turned: Floats = self.rotations[self.chain.last_screw[frame]] @ self.chain.homes[frame][:3, :3]
        return turned

    def axis(self, screw: int) -> tuple[Floats, Floats]:
        """Return (n, 3) direction and (n, 3) point of screw number `screw` (from 0), moved by the screws before it."""
        s = self.chain.screws[screw]
        R, t = self.rotations[s.before], self.shifts_mm[s.before]
        return R @ s.axis, R @ s.point_mm + t


def pose_chain(chain: ScrewChain, joints: Mapping[str, Floats], further: Mapping[int, Floats] | None = None) -> Posture:
    """Return the posture at n sets of joint values by multiplying the exponentials.

    Args:
        chain: the machine.
        joints: joint name -> (n,) values, rad or mm.
        further: number of a screw (from 0) -> (n,) motion in addition to that of the joints, rad or mm.
    """
    further = further or {}
    n = len(next(iter(joints.values())))
    posture = Posture(chain, [np.broadcast_to(np.eye(3), (n, 3, 3))], [np.zeros((n, 3))])
    for index, screw in enumerate(chain.screws):
        R, t = posture.rotations[screw.before], posture.shifts_mm[screw.before]
        amount = further.get(index, np.zeros(n))
        for name, coefficient in screw.weights.items():
            amount = amount + coefficient * joints[name]
        if screw.turns:
            turn = rotation(screw.axis, amount)
            t = (R @ (screw.point_mm - turn @ screw.point_mm)[:, :, None])[:, :, 0] + t
            R = R @ turn
        else:
            t = (R @ (amount[:, None] * screw.axis)[:, :, None])[:, :, 0] + t
        posture.rotations.append(R)
        posture.shifts_mm.append(t)
    return posture
