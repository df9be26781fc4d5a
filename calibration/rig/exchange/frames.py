"""Row constants of modified Denavit-Hartenberg frames for given joint axes, exact to rounding.

Rows follow the convention `mdh_beta_after`: Trans(x,a) Rot(x,alpha) Trans(z,d) Rot(z,theta) Rot(y,beta). The frame
after a row is fixed to its link, and its x axis depends on the next joint axis: x is along the common normal (Craig,
Introduction to Robotics, ch. 3). If the axes are nearly parallel, x points towards the next joint, with the angle beta
between the axes (Hayati and Mirmirani, 1985), so that all lengths stay bounded. Lengths mm, angles rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig.parts import NEARLY_PARALLEL

Floats = NDArray[np.float64]

_COAXIAL_MM = 1e-10
_NOTHING = 1e-15  # rounding error of a cosine
_SNAP = 1e-12  # deg and mm: larger than rounding errors of the arithmetic, smaller than digits of the file


@dataclass(frozen=True)
class Line:
    """A joint's axis: a unit vector (3,) and a point on it (3,), at zero joint values in the base frame."""

    direction: Floats
    point_mm: Floats


@dataclass(frozen=True)
class Link:
    """The frame after a row and the step from there to the next axis.

    Attributes:
        before_beta: (4, 4) frame on the row's own axis, before Rot(y,beta).
        beta: constant of the row, rad.
        a, alpha: constants of the next row, mm and rad.
        is_parallel: True if the two axes are nearly parallel, so that beta can be identified and d cannot.
    """

    before_beta: Floats
    beta: float
    a: float
    alpha: float
    is_parallel: bool


def link_frame(axis: Line, following: Line, x_hint: Floats) -> Link:
    """Choose the frame of a link between two axes.

    Args:
        axis: axis of the link's own joint.
        following: axis of the next joint.
        x_hint: (3,) direction of x if the two axes do not determine it.
    """
    z, u = axis.direction, following.direction
    between = following.point_mm - axis.point_mm
    if abs(float(z @ u)) > NEARLY_PARALLEL:
        return _parallel(axis, following, x_hint)
    normal = np.cross(z, u)
    sine = float(np.linalg.norm(normal))
    x = normal / sine
    if (a := float(between @ x)) < -_COAXIAL_MM or (abs(a) <= _COAXIAL_MM and float(x @ x_hint) < 0.0):
        x, a = -x, -a
    along = float(np.cross(between, u) @ normal) / sine**2  # position of the common normal's foot along the own axis
    alpha = math.atan2(float(np.cross(z, u) @ x), float(z @ u))
    return Link(_frame(z, x, axis.point_mm + along * z), 0.0, a, alpha, is_parallel=False)


def _parallel(axis: Line, following: Line, x_hint: Floats) -> Link:
    z = axis.direction
    across = _across(following.point_mm - axis.point_mm, z)
    x = across if float(np.linalg.norm(across)) > _COAXIAL_MM else _across(x_hint, z)
    frame = _frame(z, x, axis.point_mm)
    ux, uy, uz = frame[:3, :3].T @ following.direction
    px, _, pz = frame[:3, :3].T @ (following.point_mm - axis.point_mm)
    cosine = math.copysign(math.hypot(ux, uz), uz)
    beta = math.atan2(ux / cosine, uz / cosine)
    a = px / math.cos(beta)
    frame[:3, 3] += (pz + a * math.sin(beta)) * z
    return Link(frame, beta, a, math.atan2(-uy, cosine), is_parallel=True)


def end_frame(axis: Line, link: Floats) -> Floats:
    """Return the (4, 4) frame after the last row of a chain: z on the axis, x as near as possible to the link's x.

    Args:
        axis: axis of the row's joint.
        link: (4, 4) frame of the link.
    """
    x = _across(link[:3, 0], axis.direction)
    if float(np.linalg.norm(x)) < 1e-6:
        x = _across(link[:3, 1], axis.direction)
    return _frame(axis.direction, x, axis.point_mm)


def step_along(start: Floats, goal: Floats) -> tuple[float, float]:
    """Return d, mm, and theta, rad, from frame `start` (4, 4) to frame `goal` (4, 4) on the same z axis."""
    between = start[:3, :3].T @ (goal[:3, 3] - start[:3, 3])
    x = start[:3, :3].T @ goal[:3, 0]
    return float(between[2]), math.atan2(x[1], x[0])


def turned(frame: Floats, axis: str, angle_rad: float) -> Floats:
    """Return a frame (4, 4) rotated about its own axis `x`, `y` or `z`."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    u, v = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(4)
    turn[u, u] = turn[v, v] = c
    turn[v, u], turn[u, v] = s, -s
    out: Floats = frame @ turn
    return out


def moved(frame: Floats, axis: int, length_mm: float) -> Floats:
    """Return a frame (4, 4) translated along its own axis 0, 1 or 2."""
    out: Floats = frame.copy()
    out[:3, 3] += length_mm * frame[:3, axis]
    return out


def angles_zyx(rotation: Floats) -> tuple[float, float, float]:
    """Return (yaw, pitch, roll) with rotation = Rot(z,yaw) Rot(y,pitch) Rot(x,roll), rad.

    Pitch and roll are computed with the yaw returned, so that the result is exact also near a pitch of 90 degrees.
    """
    level = rotation[1, 0], rotation[0, 0]
    yaw = math.atan2(*level) if math.hypot(*level) > _NOTHING else 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    rest = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    return yaw, math.atan2(-rest[2, 0], rest[0, 0]), math.atan2(-rest[1, 2], rest[1, 1])


def tidy(value: float) -> float:
    """Return a number of deg or mm without the rounding errors of the arithmetic that computed it."""
    value = float(value)
    for digits in range(10):
        near = round(value, digits)
        if abs(near - value) <= _SNAP * max(1.0, abs(value) / 100.0):
            return near + 0.0
    return value


def _across(vector: Floats, axis: Floats) -> Floats:
    out: Floats = vector - (vector @ axis) * axis
    return out


def _frame(z: Floats, x: Floats, origin_mm: Floats) -> Floats:
    out = np.eye(4)
    x = _across(x, z)
    x = x / np.linalg.norm(x)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = x, np.cross(z, x), z, origin_mm
    return out
