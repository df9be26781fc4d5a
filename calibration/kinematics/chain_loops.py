"""Compiled forward kinematics and derivatives: one walk over the rows of a rig, and steps that use its results.

An elementary transform with axis u through origin o moves a point P beyond it by u x (P - o) per rad of a rotation and
by u per mm of a translation. So the walk keeps axis and origin of every transform, from which all derivatives follow.

Functions that are compiled together are all in this file, as numba caches machine code until a function's own file
changes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled, inlined
from calibration.observations import Floats

Integers = NDArray[np.intp]


class Transforms(NamedTuple):
    """The elementary transforms of all rows, one after the other.

    Attributes:
        kind: (k, 3) 1 for a rotation, else 0; axis; index of the parameter (-1: none).
        amount: (k, 3) constant part in rad or mm, and its cosine and sine.
        drive_start, drive_joint, drive_size: transform k has the drives from drive_start[k] to drive_start[k + 1] - 1,
            each with the index of its joint and its coefficient.
        row_start: row i has the transforms from row_start[i] to row_start[i + 1] - 1.
        frame_before: (rows,) frame at which each row starts, 0 for the base.
    """

    kind: Integers
    amount: Floats
    drive_start: Integers
    drive_joint: Integers
    drive_size: Floats
    row_start: Integers
    frame_before: Integers


class Points(NamedTuple):
    """Points fixed to frames.

    Attributes:
        frame: (m,) frame of each point.
        offset: (m, 3) offset of each point in its frame, mm.
        parameter: (m,) index of the first of the three parameters of the offset.
        path_start, path: the transforms that move point i are path[path_start[i] : path_start[i + 1]].
    """

    frame: Integers
    offset: Floats
    parameter: Integers
    path_start: Integers
    path: Integers


@compiled
def settle(x: Floats, kind: Integers, constant: Floats, amount: Floats) -> None:
    """Fill `amount` (k, 3) of transforms for parameters (p,) and nominal sizes (k,)."""
    for k in range(len(kind)):
        size = constant[k] + (x[kind[k, 2]] if kind[k, 2] >= 0 else 0.0)
        amount[k, 0], amount[k, 1], amount[k, 2] = size, math.cos(size), math.sin(size)


@compiled
def place_bases(x: Floats, rotation: Floats, translation: Floats, first: int, bases: Floats) -> None:
    """Fill `bases` (setups, 7, 3): Trans(x, y, z) Rot(z) Rot(y) Rot(x) times every placement.

    The first three vectors are the rotation, the fourth is the origin, and the last three are the axes through it about
    which rz, ry and rx turn. The parameters of the bases are those of `x` (p,) from index `first` on.
    """
    for b in range(len(rotation)):
        at, base = first + 6 * b, bases[b]
        cz, sz = math.cos(x[at + 3]), math.sin(x[at + 3])
        cy, sy = math.cos(x[at + 4]), math.sin(x[at + 4])
        cx, sx = math.cos(x[at + 5]), math.sin(x[at + 5])
        for j in range(3):
            r0, r1, r2 = rotation[b, 0, j], rotation[b, 1, j], rotation[b, 2, j]
            r1, r2 = cx * r1 - sx * r2, sx * r1 + cx * r2
            r2, r0 = cy * r2 - sy * r0, sy * r2 + cy * r0
            base[0, j], base[1, j], base[2, j] = cz * r0 - sz * r1, sz * r0 + cz * r1, r2
            base[3, j] = translation[b, j] + x[at + j]
        base[4, 0], base[4, 1], base[4, 2] = 0.0, 0.0, 1.0
        base[5, 0], base[5, 1], base[5, 2] = -sz, cz, 0.0
        base[6, 0], base[6, 1], base[6, 2] = cz * cy, sz * cy, -sy


@inlined
def start_at_station(base: Floats, ends: Floats, frames: Floats) -> None:
    """Start a walk at the base (7, 3), so that its results are in the station's frame."""
    for i in range(3):
        frames[0, i] = base[3, i]
        for j in range(3):
            ends[0, i, j] = base[j, i]


@inlined
def walk(
    readings: Floats, first: int, last: int, transforms: Transforms, ends: Floats, kept: Floats, frames: Floats
) -> None:
    """Walk the rows from `first` to `last` - 1 of one pose, from a start that is already set.

    `ends` (rows + 1, 3, 3) receives the axes (as rows) after each row, and `frames` (rows + 1, 3) the origins. `kept`
    (transforms, 6) receives the axis and the origin of each transform.
    """
    kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before = transforms
    for row in range(first, last):
        before, frame, origin = frame_before[row], ends[row + 1], frames[row + 1]
        for i in range(3):
            origin[i] = frames[before, i]
            for j in range(3):
                frame[i, j] = ends[before, i, j]
        for k in range(row_start[row], row_start[row + 1]):
            a = kind[k, 1]
            for j in range(3):
                kept[k, j], kept[k, 3 + j] = frame[a, j], origin[j]
            size, c, s = amount[k, 0], amount[k, 1], amount[k, 2]
            for i in range(drive_start[k], drive_start[k + 1]):
                size += drive_size[i] * readings[drive_joint[i]]
            if kind[k, 0] == 0:
                for j in range(3):
                    origin[j] += size * frame[a, j]
                continue
            if drive_start[k + 1] > drive_start[k]:
                c, s = math.cos(size), math.sin(size)
            u, v = a + 1 if a < 2 else 0, a - 1 if a > 0 else 2
            for j in range(3):
                old = frame[u, j]
                frame[u, j] = c * old + s * frame[v, j]
                frame[v, j] = c * frame[v, j] - s * old


@inlined
def walk_from_base(readings: Floats, transforms: Transforms, ends: Floats, kept: Floats, frames: Floats) -> None:
    """Walk all rows of one pose in the base frame."""
    for i in range(3):
        frames[0, i] = 0.0
        for j in range(3):
            ends[0, i, j] = 1.0 if i == j else 0.0
    walk(readings, 0, len(transforms.frame_before), transforms, ends, kept, frames)


@inlined
def place_point(offset: Floats, frame: Floats, origin: Floats, out: Floats) -> None:
    """Fill `out` (3,) with the position of a point fixed to a frame (3, 3; axes as rows)."""
    for j in range(3):
        out[j] = origin[j] + offset[0] * frame[0, j] + offset[1] * frame[1, j] + offset[2] * frame[2, j]


@inlined
def _moved(k: int, x: float, y: float, z: float, kind: Integers, kept: Floats) -> tuple[float, float, float]:
    """Return the displacement of the point x, y, z by transform k, mm per rad or mm."""
    a0, a1, a2 = kept[k, 0], kept[k, 1], kept[k, 2]
    if kind[k, 0] == 0:
        return a0, a1, a2
    d0, d1, d2 = x - kept[k, 3], y - kept[k, 4], z - kept[k, 5]
    return a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0


@inlined
def by_transforms(
    place: Floats,
    point: int,
    transforms: Transforms,
    points: Points,
    kept: Floats,
    wanted: bool,
    by_joint: Floats,
    by_parameter: Floats,
) -> None:
    """Fill derivatives of a point, zero at first: by readings (3, joints) and, if wanted, by parameters (3, q)."""
    kind, drive_start = transforms.kind, transforms.drive_start
    drive_joint, drive_size, path = transforms.drive_joint, transforms.drive_size, points.path
    x, y, z = place[0], place[1], place[2]
    for entry in range(points.path_start[point], points.path_start[point + 1]):
        k = path[entry]
        first, last = drive_start[k], drive_start[k + 1]
        if first == last and not wanted:
            continue
        m0, m1, m2 = _moved(k, x, y, z, kind, kept)
        index = kind[k, 2]
        if wanted and index >= 0:
            by_parameter[0, index], by_parameter[1, index], by_parameter[2, index] = m0, m1, m2
        for i in range(first, last):
            j, size = drive_joint[i], drive_size[i]
            by_joint[0, j] += size * m0
            by_joint[1, j] += size * m1
            by_joint[2, j] += size * m2


@inlined
def by_offset(axes: Floats, first: int, out: Floats) -> None:
    """Fill three columns of `out` (3, q), from `first` on, with the axes (as rows) of the frame of a point."""
    for i in range(3):
        for j in range(3):
            out[j, first + i] = axes[i, j]


@inlined
def by_base(arm: Floats, base: Floats, first: int, out: Floats) -> None:
    """Fill six columns of `out` (3, q), from `first` on and initially zero, with derivatives by the base's parameters.

    All are in the station's frame; `arm` (3,) is the vector from the base's origin to the point.
    """
    for i in range(3):
        a0, a1, a2 = base[4 + i, 0], base[4 + i, 1], base[4 + i, 2]
        out[i, first + i] = 1.0
        out[0, first + 3 + i] = a1 * arm[2] - a2 * arm[1]
        out[1, first + 3 + i] = a2 * arm[0] - a0 * arm[2]
        out[2, first + 3 + i] = a0 * arm[1] - a1 * arm[0]


@inlined
def turn_back(base: Floats, first: int, out: Floats) -> None:
    """Turn six columns of `out` (3, q), from `first` on, from the station's frame into the base frame."""
    for i in range(first, first + 6):
        m0, m1, m2 = out[0, i], out[1, i], out[2, i]
        for j in range(3):
            out[j, i] = base[0, j] * m0 + base[1, j] * m1 + base[2, j] * m2


@inlined
def by_coefficients(column: Floats, shift: Floats, joint: Integers, by_joint: Floats, out: Floats) -> None:
    """Fill the last columns of `out` (3, q) with the derivatives of a point by coefficients of effects.

    Args:
        column: (k,) change of the joint per unit of each coefficient.
        shift: (3, k) additional displacement of the point per unit; no columns if no coefficient has one.
        joint: (k,) joint of each coefficient, -1 for none.
        by_joint: (3, joints) derivatives by the readings.
        out: (3, q) derivatives, to be filled.
    """
    first = out.shape[1] - len(column)
    for c in range(len(column)):
        if joint[c] >= 0:
            for j in range(3):
                out[j, first + c] = column[c] * by_joint[j, joint[c]]
    for c in range(shift.shape[1]):
        for j in range(3):
            out[j, first + c] += shift[j, c]


@compiled
def linearise(
    readings: Floats,
    prism: Integers,
    setup: Integers,
    kind: Integers,
    amount: Floats,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    row_start: Integers,
    frame_before: Integers,
    frame: Integers,
    offset: Floats,
    parameter: Integers,
    path_start: Integers,
    path: Integers,
    bases: Floats,
    base_start: int,
    position: Floats,
    jacobian: Floats,
    by_joint: Floats,
) -> None:
    """Fill `position` (n, 3) in the station's frame, and the initially zero Jacobians if they have rows.

    The fields of `Transforms` and `Points` are separate arguments, because passing each tuple would cost a microsecond,
    which matters for few rows. `bases` (setups, 7, 3) are from `place_bases`, with their parameters from `base_start`
    on. `jacobian` is (n, 3, p) and `by_joint` (n, 3, joints).
    """
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    points = Points(frame, offset, parameter, path_start, path)
    rows = len(transforms.frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(transforms.kind), 6)), np.empty((rows + 1, 3))
    arm = np.empty(3)
    for n in range(len(prism)):
        point, at, base = prism[n], frame[prism[n]], bases[setup[n]]
        start_at_station(base, ends, frames)
        walk(readings[n], at - 1, at, transforms, ends, kept, frames)
        place_point(offset[point], ends[at], frames[at], position[n])
        if len(jacobian) == 0:
            continue
        by_transforms(position[n], point, transforms, points, kept, True, by_joint[n], jacobian[n])
        by_offset(ends[at], parameter[point], jacobian[n])
        for i in range(3):
            arm[i] = position[n, i] - base[3, i]
        by_base(arm, base, base_start + 6 * setup[n], jacobian[n])


@compiled
def work(
    readings: Floats,
    force: Floats,
    direction: Floats,
    kind: Integers,
    amount: Floats,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    row_start: Integers,
    frame_before: Integers,
    frame: Integers,
    offset: Floats,
    out: Floats,
) -> None:
    """Fill `out` (n, joints) with the work of forces (n, points) along `direction` (n, 3), per unit of each reading.

    Forces and directions that are equal in all rows may have a single row. The loop runs from the last row back to the
    base. Each transform moves all points beyond it, so the sum and the moment of their forces are sufficient.
    """
    rows = len(frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(kind), 6)), np.empty((rows + 1, 3))
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    place, beyond = np.empty(3), np.empty((rows + 1, 4))
    for n in range(len(readings)):
        pull, along = force[n if len(force) > 1 else 0], direction[n if len(direction) > 1 else 0]
        d0, d1, d2 = along[0], along[1], along[2]
        out[n] = 0.0
        beyond[:] = 0.0
        walk_from_base(readings[n], transforms, ends, kept, frames)
        for m in range(len(frame)):
            place_point(offset[m], ends[frame[m]], frames[frame[m]], place)
            beyond[frame[m], 3] += pull[m]
            for i in range(3):
                beyond[frame[m], i] += pull[m] * place[i]
        for row in range(rows, 0, -1):
            total = beyond[row, 3]
            for k in range(row_start[row - 1], row_start[row]):
                if drive_start[k + 1] == drive_start[k]:
                    continue
                a0, a1, a2 = kept[k, 0], kept[k, 1], kept[k, 2]
                done = total * (d0 * a0 + d1 * a1 + d2 * a2)
                if kind[k, 0] != 0:
                    m0 = beyond[row, 0] - total * kept[k, 3]
                    m1 = beyond[row, 1] - total * kept[k, 4]
                    m2 = beyond[row, 2] - total * kept[k, 5]
                    done = d0 * (a1 * m2 - a2 * m1) + d1 * (a2 * m0 - a0 * m2) + d2 * (a0 * m1 - a1 * m0)
                for i in range(drive_start[k], drive_start[k + 1]):
                    out[n, drive_joint[i]] += drive_size[i] * done
            for i in range(4):
                beyond[frame_before[row - 1], i] += beyond[row, i]


@compiled
def places(
    readings: Floats,
    transforms: Transforms,
    frame: Integers,
    offset: Floats,
    out: Floats,
) -> None:
    """Fill `out` (n, points, 3) with the positions of points fixed to frames, in the base frame."""
    rows = len(transforms.frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(transforms.kind), 6)), np.empty((rows + 1, 3))
    for n in range(len(readings)):
        walk_from_base(readings[n], transforms, ends, kept, frames)
        for m in range(len(frame)):
            place_point(offset[m], ends[frame[m]], frames[frame[m]], out[n, m])


@compiled
def face(
    readings: Floats,
    prism: Integers,
    transforms: Transforms,
    points: Points,
    axes: Floats,
    by_drive: Floats,
) -> None:
    """Fill `axes` (n, 3, 3; as rows) of the prisms' frames and `by_drive` (n, 3, drives), both in the base frame."""
    rows = len(transforms.frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(transforms.kind), 6)), np.empty((rows + 1, 3))
    place = np.empty(3)
    for n in range(len(prism)):
        point = prism[n]
        at = points.frame[point]
        walk_from_base(readings[n], transforms, ends, kept, frames)
        place_point(points.offset[point], ends[at], frames[at], place)
        axes[n] = ends[at]
        by_drive[n] = 0.0
        for entry in range(points.path_start[point], points.path_start[point + 1]):
            k = points.path[entry]
            m0, m1, m2 = _moved(k, place[0], place[1], place[2], transforms.kind, kept)
            for i in range(transforms.drive_start[k], transforms.drive_start[k + 1]):
                size = transforms.drive_size[i]
                by_drive[n, 0, i], by_drive[n, 1, i], by_drive[n, 2, i] = size * m0, size * m1, size * m2
