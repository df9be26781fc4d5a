"""Forward kinematics in NumPy, transform by transform: the oracle of the compiled loops."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain, ChainData, Linearisation, Op, X, Y, Z, rotation_about
from calibration.observations import Floats

Integers = NDArray[np.intp]
# Axes of a frame and its origin: arrays (3, m).
_Frame = tuple[list[Floats], Floats]


class _Visited(NamedTuple):
    op: Op
    axis: Floats  # (3, m) in the station's frame
    origin: Floats  # (3, m)


class NumpyChain:
    """The same positions and derivatives as a chain's own."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain

    def positions_mm(self, x: Floats, data: ChainData) -> Floats:
        """(n, 3) prism positions in the station's frame for parameters `x` (p,)."""
        position = np.empty((len(data), 3))
        for prism, rows in _groups(data.prism):
            position[rows] = self._visit(x, data, rows, self._chain.prism_chain(prism), []).T
        return position

    def linearise(self, x: Floats, data: ChainData) -> Linearisation:
        """Positions and both Jacobians in one pass."""
        n = len(data)
        position = np.empty((n, 3))
        jacobian = np.zeros((n, 3, len(self._chain)))
        by_joint = np.zeros((n, 3, len(self._chain.rig.joints)))
        for prism, rows in _groups(data.prism):
            visited: list[_Visited] = []
            point = self._visit(x, data, rows, self._chain.prism_chain(prism), visited)
            position[rows] = point.T
            self._base_jacobian(x, data, rows, point, jacobian)
            for op, axis, origin in visited:
                moved = _cross(axis, point - origin) if op.rotates else axis
                if op.parameter >= 0:
                    jacobian[rows, :, op.parameter] = moved.T
                for joint, coefficient in op.drive:
                    by_joint[rows, :, joint] += coefficient * moved.T
        return Linearisation(position, jacobian, by_joint)

    def frames_mm(self, x: Floats, data: ChainData) -> Floats:
        """(n, rows, 3) origins of the frames after each row, in the base frame."""
        rig = self._chain.rig
        origins = np.empty((len(data), len(rig.rows), 3))
        ends = [self._start(x, data, None)]
        for number, ops in enumerate(self._chain.row_ops, 1):
            before = ends[rig.path(number)[-2] if len(rig.path(number)) > 1 else 0]
            *_, end = self._walk(x, data.readings, ops, before)
            ends.append(end)
            origins[:, number - 1] = end[1].T
        return origins

    def _base(self, x: Floats, setup: int) -> tuple[Floats, Floats]:
        placement = self._chain.placements[self._chain.setups[setup]]
        deviation = x[self._chain.base_index(setup)]
        rotation = np.eye(3)
        for axis, angle in zip((Z, Y, X), deviation[3:], strict=True):
            rotation = rotation @ rotation_about(axis, float(angle))
        return rotation @ placement.rotation, placement.translation_mm + deviation[:3]

    def _base_jacobian(self, x: Floats, data: ChainData, rows: Integers, point: Floats, jacobian: Floats) -> None:
        """The base deviates by Trans(x, y, z) Rot(z) Rot(y) Rot(x) in front of its placement."""
        for setup, own in _groups(data.setup[rows]):
            index = self._chain.base_index(setup)
            _, translation_mm = self._base(x, setup)
            target = rows[own]
            jacobian[target, :, index.start : index.start + 3] = np.eye(3)
            arm = point[:, own] - translation_mm[:, None]
            rotation = np.eye(3)
            for offset, axis in enumerate((Z, Y, X), 3):
                jacobian[target, :, index.start + offset] = _cross(rotation[:, axis][:, None], arm).T
                rotation = rotation @ rotation_about(axis, float(x[index.start + offset]))

    def _visit(self, x: Floats, data: ChainData, rows: Integers, ops: Sequence[Op], visited: list[_Visited]) -> Floats:
        walk = self._walk(x, data.readings[rows], ops, self._start(x, data, rows))
        columns, origin = next(walk)
        for op in ops:
            if op.parameter >= 0 or op.drive:
                visited.append(_Visited(op, columns[op.axis], origin))
            columns, origin = next(walk)
        return origin

    def _start(self, x: Floats, data: ChainData, rows: Integers | None) -> _Frame:
        """The base in the station's frame for the given rows; for `rows` None the base frame itself, for all."""
        if rows is None:
            return [np.tile(np.eye(3)[:, [axis]], len(data)) for axis in (X, Y, Z)], np.zeros((3, len(data)))
        setup = data.setup[rows]
        bases = [self._base(x, s) for s in range(len(self._chain.setups))]
        rotation = np.array([base[0] for base in bases])
        columns = [np.ascontiguousarray(rotation[:, :, axis][setup].T) for axis in (X, Y, Z)]
        return columns, np.ascontiguousarray(np.array([base[1] for base in bases])[setup].T)

    def _walk(self, x: Floats, readings: Floats, ops: Iterable[Op], start: _Frame) -> Iterator[_Frame]:
        """Yield the frame before the first and after each transform."""
        columns, origin = start
        yield start
        for op in ops:
            deviation = x[op.parameter] if op.parameter >= 0 else 0.0
            size = op.driven(readings) + deviation if op.drive else op.constant + deviation
            if op.rotates:
                c, s = np.cos(size), np.sin(size)
                u, v = (op.axis + 1) % 3, (op.axis + 2) % 3
                turned = list(columns)
                turned[u] = c * columns[u] + s * columns[v]
                turned[v] = c * columns[v] - s * columns[u]
                columns = turned
            else:
                origin = origin + size * columns[op.axis]
            yield columns, origin


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product of (3, m) arrays; several times faster than `np.cross` along the first axis."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _groups(labels: Integers) -> Iterator[tuple[int, Integers]]:
    """Every label that occurs with its rows."""
    for label in np.unique(labels):
        yield int(label), np.flatnonzero(labels == label)
