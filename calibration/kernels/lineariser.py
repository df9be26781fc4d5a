"""Compiled positions and Jacobians: what `Chain.linearise` yields, several times faster.

Each observation's chain is walked once from the base, the axis and origin of every transform that a parameter or a
joint sizes are kept, and each moves the point by axis x (point - origin) per rad or by axis per mm.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from calibration.kernels.jit import compiled
from calibration.kinematics import Chain, ChainData, Linearisation, Op
from calibration.observations import Floats

Integers = NDArray[np.intp]
Flags = NDArray[np.bool_]


@compiled
def _place_bases(
    x: Floats, rotation: Floats, translation: Floats, first: int, frame: Floats, origin: Floats, axes: Floats
) -> None:
    """Trans(x, y, z) Rot(z) Rot(y) Rot(x) times every placement.

    `frame` (setups, 3, 3) gets the base axes as rows, `origin` (setups, 3) where they meet, and `axes` (setups, 3, 3)
    the three lines about which rz, ry and rx turn.
    """
    for b in range(len(rotation)):
        at = first + 6 * b
        cz, sz = math.cos(x[at + 3]), math.sin(x[at + 3])
        cy, sy = math.cos(x[at + 4]), math.sin(x[at + 4])
        cx, sx = math.cos(x[at + 5]), math.sin(x[at + 5])
        for j in range(3):
            r0, r1, r2 = rotation[b, 0, j], rotation[b, 1, j], rotation[b, 2, j]
            r1, r2 = cx * r1 - sx * r2, sx * r1 + cx * r2
            r2, r0 = cy * r2 - sy * r0, sy * r2 + cy * r0
            frame[b, j, 0], frame[b, j, 1], frame[b, j, 2] = cz * r0 - sz * r1, sz * r0 + cz * r1, r2
            origin[b, j] = translation[b, j] + x[at + j]
        axes[b, 0, 0], axes[b, 0, 1], axes[b, 0, 2] = 0.0, 0.0, 1.0
        axes[b, 1, 0], axes[b, 1, 1], axes[b, 1, 2] = -sz, cz, 0.0
        axes[b, 2, 0], axes[b, 2, 1], axes[b, 2, 2] = cz * cy, sz * cy, -sy


@compiled
def _walk(
    readings: Floats,
    first: int,
    last: int,
    rotates: Flags,
    axis: Integers,
    fixed: Floats,
    cosine: Floats,
    sine: Floats,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    frame: Floats,
    origin: Floats,
    kept: Floats,
) -> None:
    """Carry `frame` (3, 3; axes as rows) and `origin` (3,) through the transforms first .. last of one observation.

    `kept` (transforms, 6) gets the axis and the origin that each acts at.
    """
    for k in range(first, last):
        a = axis[k]
        for j in range(3):
            kept[k, j], kept[k, 3 + j] = frame[a, j], origin[j]
        size, c, s = fixed[k], cosine[k], sine[k]
        for i in range(drive_start[k], drive_start[k + 1]):
            size += drive_size[i] * readings[drive_joint[i]]
        if not rotates[k]:
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
def _derive(
    first: int,
    last: int,
    rotates: Flags,
    parameter: Integers,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    point: Floats,
    kept: Floats,
    jacobian: Floats,
    by_joint: Floats,
) -> None:
    """What the transforms first .. last do to the `point` (3,) of one observation."""
    o0, o1, o2 = point[0], point[1], point[2]
    for k in range(first, last):
        p = parameter[k]
        if p < 0 and drive_start[k + 1] == drive_start[k]:
            continue
        a0, a1, a2 = kept[k, 0], kept[k, 1], kept[k, 2]
        if rotates[k]:
            d0, d1, d2 = o0 - kept[k, 3], o1 - kept[k, 4], o2 - kept[k, 5]
            a0, a1, a2 = a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0
        if p >= 0:
            jacobian[0, p], jacobian[1, p], jacobian[2, p] = a0, a1, a2
        for i in range(drive_start[k], drive_start[k + 1]):
            j, size = drive_joint[i], drive_size[i]
            by_joint[0, j] += size * a0
            by_joint[1, j] += size * a1
            by_joint[2, j] += size * a2


@compiled
def _derive_base(origin: Floats, axes: Floats, point: Floats, first: int, jacobian: Floats) -> None:
    """What the six parameters of its base, from column `first` on, do to the `point` (3,) of one observation."""
    d0, d1, d2 = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    for i in range(3):
        jacobian[i, first + i] = 1.0
        a0, a1, a2 = axes[i, 0], axes[i, 1], axes[i, 2]
        jacobian[0, first + 3 + i] = a1 * d2 - a2 * d1
        jacobian[1, first + 3 + i] = a2 * d0 - a0 * d2
        jacobian[2, first + 3 + i] = a0 * d1 - a1 * d0


@compiled
def _linearise(
    x: Floats,
    readings: Floats,
    prism: Integers,
    setup: Integers,
    rotates: Flags,
    axis: Integers,
    constant: Floats,
    parameter: Integers,
    drive_start: Integers,
    drive_joint: Integers,
    drive_size: Floats,
    op_start: Integers,
    base_rotation: Floats,
    base_translation: Floats,
    base_start: int,
    position: Floats,
    jacobian: Floats,
    by_joint: Floats,
) -> None:
    """Fill position (n, 3), jacobian (n, 3, p) and by_joint (n, 3, joints), the latter two zero at first.

    The transforms of prism i are op_start[i] .. op_start[i + 1], the drives of transform k drive_start[k] ..
    """
    fixed, cosine, sine = np.empty(len(axis)), np.empty(len(axis)), np.empty(len(axis))
    for k in range(len(axis)):
        fixed[k] = constant[k] + (x[parameter[k]] if parameter[k] >= 0 else 0.0)
        cosine[k], sine[k] = math.cos(fixed[k]), math.sin(fixed[k])
    setups = len(base_rotation)
    base_frame, base_axes = np.empty((setups, 3, 3)), np.empty((setups, 3, 3))
    base_origin = np.empty((setups, 3))
    _place_bases(x, base_rotation, base_translation, base_start, base_frame, base_origin, base_axes)
    frame, kept = np.empty((3, 3)), np.empty((len(axis), 6))
    for n in range(len(prism)):
        base, first, last = setup[n], op_start[prism[n]], op_start[prism[n] + 1]
        point, columns = position[n], jacobian[n]
        for i in range(3):
            point[i] = base_origin[base, i]
            for j in range(3):
                frame[i, j] = base_frame[base, i, j]
        _walk(
            readings[n],
            first,
            last,
            rotates,
            axis,
            fixed,
            cosine,
            sine,
            drive_start,
            drive_joint,
            drive_size,
            frame,
            point,
            kept,
        )
        _derive(
            first,
            last,
            rotates,
            parameter,
            drive_start,
            drive_joint,
            drive_size,
            point,
            kept,
            columns,
            by_joint[n],
        )
        _derive_base(base_origin[base], base_axes[base], point, base_start + 6 * base, columns)


class Lineariser:
    """`Chain.linearise`, compiled; build it once for a chain and call it for any parameters and rows."""

    def __init__(self, chain: Chain) -> None:
        chains = [chain.prism_chain(prism) for prism in range(len(chain.prism_ops))]
        ops: list[Op] = [op for one in chains for op in one]
        drives = [drive for op in ops for drive in op.drive]
        self._shape = len(chain), len(chain.rig.joints)
        placements = [chain.placements[s] for s in chain.setups]
        self._tables = (
            np.array([op.rotates for op in ops], dtype=np.bool_),
            np.array([op.axis for op in ops], dtype=np.intp),
            np.array([op.constant for op in ops], dtype=np.float64),
            np.array([op.parameter for op in ops], dtype=np.intp),
            np.array(list(accumulate((len(op.drive) for op in ops), initial=0)), dtype=np.intp),
            np.array([joint for joint, _ in drives], dtype=np.intp),
            np.array([size for _, size in drives], dtype=np.float64),
            np.array(list(accumulate(map(len, chains), initial=0)), dtype=np.intp),
            np.array([p.rotation for p in placements], dtype=np.float64).reshape(-1, 3, 3),
            np.array([p.translation_mm for p in placements], dtype=np.float64).reshape(-1, 3),
            chain.base_start,
        )

    def __call__(self, x: Floats, data: ChainData) -> Linearisation:
        """Positions and both Jacobians of n rows for parameters `x` (p,)."""
        n, (p, joints) = len(data), self._shape
        out = Linearisation(np.empty((n, 3)), np.zeros((n, 3, p)), np.zeros((n, 3, joints)))
        readings = np.ascontiguousarray(data.readings, dtype=np.float64)
        values = np.ascontiguousarray(x, dtype=np.float64)
        _linearise(values, readings, data.prism, data.setup, *self._tables, *out)
        return out
