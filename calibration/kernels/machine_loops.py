"""The loops behind `calibration.kernels.machine`: one walk over the rows of a rig, and what follows from it.

All that is compiled together is in this file: numba keeps a function's machine code as long as its own file stays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.kernels.jit import compiled
from calibration.observations import Floats

Integers = NDArray[np.intp]


class Transforms(NamedTuple):
    """The elementary transforms of all rows, one after the other.

    Attributes:
        kind: (k, 3) whether it rotates, its axis, its parameter (-1: none).
        amount: (k, 3) its constant part in rad or mm, and cosine and sine of that.
        drive_start, drive_joint, drive_size: the drives of transform k are drive_start[k] .. drive_start[k + 1].
        row_start: the transforms of row i are row_start[i] .. row_start[i + 1].
        frame_before: (rows,) the frame that each continues from, 0 for the base.
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
        frame, offset: (m,) and (m, 3) mm.
        path_start, path: the transforms that move point i are path[path_start[i] : path_start[i + 1]].
    """

    frame: Integers
    offset: Floats
    path_start: Integers
    path: Integers


class Uncertainty(NamedTuple):
    """What is not known of the machine and of a fix.

    Attributes:
        root: (q, q) lower triangular; root @ root' is the covariance of parameters and coefficients of effects.
        prism_parameter: (prisms,) the first of the three of each prism's offset.
        base_start: the first of the bases' parameters.
        coefficient_joint: (k,) the joint that each coefficient changes, -1 for none; they are the last of the q.
        station: distance in mm and ppm, circles in rad, centring in mm, repeats in mm, instant in s: 1 sigma each.
    """

    root: Floats
    prism_parameter: Integers
    base_start: int
    coefficient_joint: Integers
    station: tuple[float, float, float, float, float, float]


@compiled
def _walk(readings: Floats, transforms: Transforms, ends: Floats, kept: Floats, frames: Floats) -> None:
    """Walk the rows of one pose from the base frame.

    `ends` (rows + 1, 3, 3) gets the axes (as rows) after each row, the base's first, and `frames` (rows + 1, 3) the
    origins; `kept` (transforms, 6) the axis and the origin that each transform acts at.
    """
    for i in range(3):
        frames[0, i] = 0.0
        for j in range(3):
            ends[0, i, j] = 1.0 if i == j else 0.0
    drive_start = transforms.drive_start
    for row in range(len(transforms.frame_before)):
        before, frame, origin = transforms.frame_before[row], ends[row + 1], frames[row + 1]
        for i in range(3):
            origin[i] = frames[before, i]
            for j in range(3):
                frame[i, j] = ends[before, i, j]
        for k in range(transforms.row_start[row], transforms.row_start[row + 1]):
            a = transforms.kind[k, 1]
            for j in range(3):
                kept[k, j], kept[k, 3 + j] = frame[a, j], origin[j]
            size, c, s = transforms.amount[k, 0], transforms.amount[k, 1], transforms.amount[k, 2]
            for i in range(drive_start[k], drive_start[k + 1]):
                size += transforms.drive_size[i] * readings[transforms.drive_joint[i]]
            if transforms.kind[k, 0] == 0:
                for j in range(3):
                    origin[j] += size * frame[a, j]
                continue
            if drive_start[k + 1] > drive_start[k]:
                c, s = math.cos(size), math.sin(size)
            u, v = (a + 1) % 3, (a + 2) % 3
            for j in range(3):
                old = frame[u, j]
                frame[u, j] = c * old + s * frame[v, j]
                frame[v, j] = c * frame[v, j] - s * old


@compiled
def _place(offset: Floats, frame: Floats, origin: Floats, out: Floats) -> None:
    """A point fixed to a frame (3, 3; axes as rows)."""
    for j in range(3):
        out[j] = origin[j] + offset[0] * frame[0, j] + offset[1] * frame[1, j] + offset[2] * frame[2, j]


@compiled
def _moved(k: int, place: Floats, transforms: Transforms, kept: Floats) -> tuple[float, float, float]:
    """What transform k does to a point, mm per rad or mm."""
    a0, a1, a2 = kept[k, 0], kept[k, 1], kept[k, 2]
    if transforms.kind[k, 0] == 0:
        return a0, a1, a2
    d0, d1, d2 = place[0] - kept[k, 3], place[1] - kept[k, 4], place[2] - kept[k, 5]
    return a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0


@compiled
def _by_joints(place: Floats, point: int, transforms: Transforms, points: Points, kept: Floats, out: Floats) -> None:
    """Fill `out` (3, joints) with what the readings do to a point."""
    out[:] = 0.0
    for entry in range(points.path_start[point], points.path_start[point + 1]):
        k = points.path[entry]
        if transforms.drive_start[k + 1] > transforms.drive_start[k]:
            m0, m1, m2 = _moved(k, place, transforms, kept)
            for i in range(transforms.drive_start[k], transforms.drive_start[k + 1]):
                j, size = transforms.drive_joint[i], transforms.drive_size[i]
                out[0, j] += size * m0
                out[1, j] += size * m1
                out[2, j] += size * m2


@compiled
def _by_parameters(
    place: Floats,
    arm: Floats,
    column: Floats,
    shift: Floats,
    point: int,
    setup: int,
    axes: Floats,
    by_joint: Floats,
    transforms: Transforms,
    points: Points,
    base: Floats,
    kept: Floats,
    unknown: Uncertainty,
    out: Floats,
) -> None:
    """Fill `out` (3, q) with what parameters and coefficients do to a point, in the base frame.

    Args:
        place, arm: the point in the base frame, and from the base's origin in the station's.
        column: (k,) what unit coefficients do to their joints.
        shift: (3, k) what they do to the point beside that; none where no coefficient does.
        axes: of the point's frame, as rows.
        base: (7, 3) of the set-up: rotation, origin and three axes, as `Machine` has them.
        others: as everywhere here.
    """
    out[:] = 0.0
    for entry in range(points.path_start[point], points.path_start[point + 1]):
        k = points.path[entry]
        index = transforms.kind[k, 2]
        if index >= 0:
            out[0, index], out[1, index], out[2, index] = _moved(k, place, transforms, kept)
    first = unknown.base_start + 6 * setup
    for i in range(3):
        a0, a1, a2 = base[4 + i, 0], base[4 + i, 1], base[4 + i, 2]
        m0, m1, m2 = a1 * arm[2] - a2 * arm[1], a2 * arm[0] - a0 * arm[2], a0 * arm[1] - a1 * arm[0]
        for j in range(3):
            out[j, unknown.prism_parameter[point] + i] = axes[i, j]
            out[j, first + i] = base[i, j]
            out[j, first + 3 + i] = base[0, j] * m0 + base[1, j] * m1 + base[2, j] * m2
    first = out.shape[1] - len(column)
    for c in range(len(column)):
        if unknown.coefficient_joint[c] >= 0:
            for j in range(3):
                out[j, first + c] = column[c] * by_joint[j, unknown.coefficient_joint[c]]
    for c in range(shift.shape[1]):
        for j in range(3):
            out[j, first + c] += shift[j, c]


@compiled
def _add_square(factor: float, m0: float, m1: float, m2: float, out: Floats) -> None:
    """Add factor * m m' to the lower triangle of `out`."""
    out[0, 0] += factor * m0 * m0
    out[1, 0] += factor * m1 * m0
    out[1, 1] += factor * m1 * m1
    out[2, 0] += factor * m2 * m0
    out[2, 1] += factor * m2 * m1
    out[2, 2] += factor * m2 * m2


@compiled
def _turn(base: Floats, half: Floats, out: Floats) -> None:
    """Fill `out` (3, 3) with R S R' for the symmetric S whose lower triangle is `half`."""
    for i in range(3):
        for j in range(i):
            half[j, i] = half[i, j]
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += base[i, k] * (base[j, 0] * half[k, 0] + base[j, 1] * half[k, 1] + base[j, 2] * half[k, 2])
            out[i, j] = total
            out[j, i] = total


@compiled
def _of_parameters(jacobian: Floats, root: Floats, scaled: Floats, out: Floats) -> None:
    """Fill the lower triangle of `out` (3, 3) with J root root' J'; `scaled` (3, q) is working space."""
    scaled[:] = 0.0
    for index in range(len(root)):
        m0, m1, m2 = jacobian[0, index], jacobian[1, index], jacobian[2, index]
        if m0 != 0.0 or m1 != 0.0 or m2 != 0.0:
            for r in range(index + 1):
                value = root[index, r]
                scaled[0, r] += m0 * value
                scaled[1, r] += m1 * value
                scaled[2, r] += m2 * value
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for r in range(len(root)):
                total += scaled[i, r] * scaled[j, r]
            out[i, j] = total


@compiled
def _of_readings(rates: Floats, variance: Floats, instant_s: float, by_joint: Floats, out: Floats) -> None:
    """Fill the lower triangle of `out` (3, 3) with what errors of the readings and of their instant do."""
    out[:] = 0.0
    v0, v1, v2 = 0.0, 0.0, 0.0
    for joint in range(len(variance)):
        m0, m1, m2 = by_joint[0, joint], by_joint[1, joint], by_joint[2, joint]
        rate = rates[joint] if math.isfinite(rates[joint]) else 0.0
        v0, v1, v2 = v0 + m0 * rate, v1 + m1 * rate, v2 + m2 * rate
        _add_square(variance[joint], m0, m1, m2, out)
    _add_square(instant_s**2, v0, v1, v2, out)


@compiled
def _add_station(
    p: Floats, sigma_mm: Floats, station: tuple[float, float, float, float, float, float], out: Floats
) -> None:
    """Add the covariance of a fix at `p` to `out` (3, 3): the station's, or the fix's own, and that of repeats."""
    distance_mm, distance_ppm, circles_rad, centring_mm, repeats_mm, _ = station
    range_mm = max(math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), 1e-6)
    radial = (distance_mm + distance_ppm * 1e-6 * range_mm) ** 2
    across = (range_mm * circles_rad) ** 2
    given = math.isfinite(sigma_mm[0]) and math.isfinite(sigma_mm[1]) and math.isfinite(sigma_mm[2])
    for i in range(3):
        out[i, i] += repeats_mm**2 + (sigma_mm[i] ** 2 if given else across + centring_mm**2)
        if not given:
            for j in range(3):
                out[i, j] += (radial - across) * p[i] * p[j] / range_mm**2


@compiled
def locate(
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
    path_start: Integers,
    path: Integers,
    bases: Floats,
    root: Floats,
    prism_parameter: Integers,
    base_start: int,
    coefficient_joint: Integers,
    station: tuple[float, float, float, float, float, float],
    column: Floats,
    shift: Floats,
    sigma_mm: Floats,
    rates: Floats,
    variance: Floats,
    position: Floats,
    place: Floats,
    frames: Floats,
    by_joint: Floats,
    by_parameter: Floats,
    of_fix: Floats,
    of_parameters: Floats,
) -> None:
    """Fill the arrays of a `Located`; `by_parameter` and both covariances only where they have rows.

    Tables come one by one: as tuples they would cost a caller of a single row several microseconds.
    """
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    points = Points(frame, offset, path_start, path)
    unknown = Uncertainty(root, prism_parameter, base_start, coefficient_joint, station)
    ends, kept = np.empty((frames.shape[1], 3, 3)), np.empty((len(kind), 6))
    jacobian, scaled = np.empty((3, by_parameter.shape[2])), np.empty((3, len(root)))
    arm, half = np.empty(3), np.empty((3, 3))
    for n in range(len(prism)):
        point, at, base = prism[n], frame[prism[n]], bases[setup[n]]
        _walk(readings[n], transforms, ends, kept, frames[n])
        _place(offset[point], ends[at], frames[n, at], place[n])
        _by_joints(place[n], point, transforms, points, kept, by_joint[n])
        for i in range(3):
            arm[i] = base[i, 0] * place[n, 0] + base[i, 1] * place[n, 1] + base[i, 2] * place[n, 2]
            position[n, i] = base[3, i] + arm[i]
        if len(by_parameter) > 0:
            jacobian = by_parameter[n]
        if len(by_parameter) > 0 or len(of_fix) > 0:
            _by_parameters(
                place[n],
                arm,
                column[n],
                shift[n],
                point,
                setup[n],
                ends[at],
                by_joint[n],
                transforms,
                points,
                base,
                kept,
                unknown,
                jacobian,
            )
        if len(of_fix) > 0:
            _of_parameters(jacobian, root, scaled, half)
            _turn(base, half, of_parameters[n])
            _of_readings(rates[n], variance[n], station[5], by_joint[n], half)
            _turn(base, half, of_fix[n])
            _add_station(position[n], sigma_mm[n], station, of_fix[n])


@compiled
def add_learned(
    setup: Integers,
    bases: Floats,
    before: Floats,
    estimate: Floats,
    weight: Floats,
    of_fix: Floats,
    of_parameters: Floats,
    of_base: Floats,
    made_good: float,
    excess: Floats,
    position: Floats,
    sigma: Floats,
) -> None:
    """Fill `position` and `sigma` (n, 3) as `Machine.learned` has them."""
    for n in range(len(setup)):
        base, counts = bases[setup[n]], weight[n]
        for i in range(3):
            place, by_parameters = before[n, i], of_parameters[n, i, i]
            variance = of_fix[n, i, i] + by_parameters - counts * made_good * (by_parameters - of_base[n, i])
            for j in range(3):
                place += base[i, j] * estimate[n, j]
                variance += base[i, j] * base[i, j] * ((1.0 - counts) * excess[0, j] + counts * excess[1, j])
            position[n, i], sigma[n, i] = place, math.sqrt(variance)


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

    Forces and directions that are the same in all rows are one.
    From the last row back to the base, each transform moves all the points beyond it: their sum and moment suffice.
    """
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    rows = len(frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(kind), 6)), np.empty((rows + 1, 3))
    place, beyond = np.empty(3), np.empty((rows + 1, 4))
    for n in range(len(readings)):
        pull, along = force[n if len(force) > 1 else 0], direction[n if len(direction) > 1 else 0]
        d0, d1, d2 = along[0], along[1], along[2]
        out[n] = 0.0
        beyond[:] = 0.0
        _walk(readings[n], transforms, ends, kept, frames)
        for m in range(len(frame)):
            _place(offset[m], ends[frame[m]], frames[frame[m]], place)
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
    """Fill `out` (n, points, 3) with where points fixed to frames are, in the base frame."""
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    rows = len(frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(kind), 6)), np.empty((rows + 1, 3))
    for n in range(len(readings)):
        _walk(readings[n], transforms, ends, kept, frames)
        for m in range(len(frame)):
            _place(offset[m], ends[frame[m]], frames[frame[m]], out[n, m])


@compiled
def face(
    readings: Floats,
    prism: Integers,
    kind: Integers,
    amount: Floats,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    row_start: Integers,
    frame_before: Integers,
    frame: Integers,
    offset: Floats,
    path_start: Integers,
    path: Integers,
    axes: Floats,
    by_drive: Floats,
) -> None:
    """Fill `axes` (n, 3, 3; as rows) of the prisms' frames and `by_drive` (n, 3, drives), both in the base frame."""
    transforms = Transforms(kind, amount, drive_start, drive_joint, drive_size, row_start, frame_before)
    rows = len(frame_before)
    ends, kept, frames = np.empty((rows + 1, 3, 3)), np.empty((len(kind), 6)), np.empty((rows + 1, 3))
    place = np.empty(3)
    for n in range(len(prism)):
        point = prism[n]
        at = frame[point]
        _walk(readings[n], transforms, ends, kept, frames)
        _place(offset[point], ends[at], frames[at], place)
        axes[n] = ends[at]
        by_drive[n] = 0.0
        for entry in range(path_start[point], path_start[point + 1]):
            k = path[entry]
            if drive_start[k + 1] > drive_start[k]:
                m0, m1, m2 = _moved(k, place, transforms, kept)
                for i in range(drive_start[k], drive_start[k + 1]):
                    by_drive[n, 0, i] = drive_size[i] * m0
                    by_drive[n, 1, i] = drive_size[i] * m1
                    by_drive[n, 2, i] = drive_size[i] * m2
