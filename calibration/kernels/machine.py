"""A machine whose parameters are settled, compiled: where its prisms are, how uncertainly, and what its joints carry.

One walk over the rows, as a tree, keeps the axis and the origin of every transform in the base frame, and whatever is
asked of a pose follows from these: a transform moves a point by axis x (point - origin) per rad of a rotation and by
axis per mm of a translation. The readable references are `Chain.linearise`, `Chain.frames_mm` and the covariances in
`calibration.identification.samples`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.kernels import machine_loops
from calibration.kernels.machine_loops import Points, Transforms, Uncertainty
from calibration.kinematics import Chain, ChainData, X, Y, Z, rotation_about
from calibration.observations import Floats

Integers = NDArray[np.intp]

_NOTHING: Floats = np.empty((0, 0))
_NONE: Integers = np.empty(0, dtype=np.intp)


class Located(NamedTuple):
    """Where prisms are, n rows.

    Attributes:
        position_mm: (n, 3) in the station's frame.
        prism_mm: (n, 3) in the base frame.
        frames_mm: (n, rows + 1, 3) origins of the base frame and of the frame after each row, in the base frame.
        joint_jacobian: (n, 3, joints) by reading, mm per deg or mm, in the base frame.
        jacobian: (n, 3, p + k) by parameter and coefficient, mm per unit, in the base frame; no rows if not wanted.
    """

    position_mm: Floats
    prism_mm: Floats
    frames_mm: Floats
    joint_jacobian: Floats
    jacobian: Floats


class Facing(NamedTuple):
    """Which way prisms face, and what each drive of a row does to them, n rows; all in the base frame.

    Attributes:
        axes: (n, 3, 3) of the prism's frame, as rows.
        by_drive: (n, 3, drives) mm per deg or mm of the reading, through one drive of `Machine.drives` alone.
    """

    axes: Floats
    by_drive: Floats


class Machine:
    """A chain at parameters that stay; build it once and ask for any rows.

    Args:
        chain: kinematics.
        x: (p,) its parameters.
        covariance: (p + k, p + k) of them and of coefficients of effects; by default all is certain.
        coefficient_joint: (k,) the joint whose value each coefficient changes, -1 for none.
        repeat_sigma_mm: what repeats of a fix scatter beyond the station's own sigma, each axis.

    Attributes:
        drives: (row number from 1, index of the joint) of everything that drives a row; a coupled joint has several.
    """

    def __init__(
        self,
        chain: Chain,
        x: Floats,
        covariance: Floats | None = None,
        coefficient_joint: Integers = _NONE,
        repeat_sigma_mm: float = 0.0,
    ) -> None:
        station = chain.rig.station
        root = np.zeros((len(chain), len(chain))) if covariance is None else _triangular(root_of(covariance))
        offsets = np.array([[op.constant + x[op.parameter] for op in ops] for ops in chain.prism_ops])
        bases = [_base(chain, x, setup) for setup in range(len(chain.setups))]
        self._bases: Floats = np.array(bases, dtype=np.float64).reshape(-1, 7, 3)
        self._rows, self._joints, self._size = len(chain.rig.rows), len(chain.rig.joints), len(root)
        self.drives = tuple(
            (number, joint) for number, ops in enumerate(chain.row_ops, 1) for op in ops for joint, _ in op.drive
        )
        self._kinematics = (
            *_transforms(chain, x),
            *_points(chain, [prism.frame for prism in chain.rig.prisms], offsets),
        )
        self._tables = (
            *self._kinematics,
            self._bases,
            *Uncertainty(
                root,
                np.array([ops[0].parameter for ops in chain.prism_ops], dtype=np.intp),
                chain.base_start,
                coefficient_joint,
                (
                    station.distance_sigma_mm,
                    station.distance_sigma_ppm,
                    math.radians(station.angle_sigma_arcsec / 3600.0),
                    station.target_sigma_mm,
                    repeat_sigma_mm,
                    station.timing_sigma_s,
                ),
            ),
        )

    def rotations(self, data: ChainData) -> Floats:
        """(n, 3, 3) from the base frame to the station's."""
        return self._bases[data.setup, :3]

    def face(self, data: ChainData) -> Facing:
        """Which way the prisms of n rows face, and what each drive does to them."""
        out = Facing(np.empty((len(data), 3, 3)), np.empty((len(data), 3, len(self.drives))))
        readings = np.ascontiguousarray(data.readings, dtype=np.float64)
        machine_loops.face(readings, data.prism, *self._kinematics, *out)
        return out

    def locate(self, data: ChainData) -> Located:
        """Where the prisms of n rows are, without the Jacobian by parameters."""
        return self._locate(data, _NOTHING, None, _NOTHING, _NOTHING, _NOTHING, wanted=False)[0]

    def linearise(self, data: ChainData, column: Floats | None = None, shift_mm: Floats | None = None) -> Located:
        """The same with the Jacobian by parameters and coefficients.

        Args:
            data: n rows, with the joints where the effects have them.
            column: (n, k) deg or mm of its joint per unit of each coefficient; may be left out where there are none.
            shift_mm: (n, 3, k) displacement in the base frame per unit of each coefficient, on top of that.
        """
        column = np.empty((len(data), 0)) if column is None else column
        return self._locate(data, column, shift_mm, _NOTHING, _NOTHING, _NOTHING, wanted=True)[0]

    def spread(
        self,
        data: ChainData,
        column: Floats,
        shift_mm: Floats | None,
        sigma_mm: Floats,
        rates: Floats,
        variance: Floats,
        *,
        jacobian: bool,
    ) -> tuple[Located, Floats, Floats]:
        """Where the prisms of n rows are, and how far from there a fix may be found.

        Args:
            data, column, shift_mm: as for `linearise`.
            sigma_mm: (n, 3) of the fix, in place of the station's where given.
            rates: (n, joints) deg/s or mm/s, NaN where not measured.
            variance: (n, joints) of each joint's value, deg^2 or mm^2.
            jacobian: whether the one by parameters is wanted.

        Returns:
            The places; (n, 3, 3) covariance of the fix (station, repeats, readings, instant) and (n, 3, 3) that by
            parameters and coefficients, mm^2, both in the station's frame.
        """
        return self._locate(data, column, shift_mm, sigma_mm, rates, variance, wanted=jacobian)

    def learned(
        self,
        data: ChainData,
        position_mm: Floats,
        estimate: Floats,
        weight: Floats,
        of_fix: Floats,
        of_parameters: Floats,
        of_base: Floats,
        made_good: float,
        excess_mm2: Floats,
    ) -> tuple[Floats, Floats]:
        """Positions with what a residual learner adds, and the standard deviation of a fix about them.

        Args:
            data: n rows.
            position_mm: (n, 3) without the learner.
            estimate, weight: (n, 3) what it adds, in the base frame, mm; (n,) how much it counts, 0 to 1.
            of_fix, of_parameters: (n, 3, 3) as from `spread`.
            of_base: (n, 3) the variance by parameters of which no learner makes anything good, mm^2.
            made_good: share of the rest that one makes good where it counts in full.
            excess_mm2: (2, 3) variance of what is lacking along the base frame's axes, without a learner and with it.

        Returns:
            (n, 3) mm and (n, 3) mm, in the station's frame.
        """
        position, sigma = np.empty((len(data), 3)), np.empty((len(data), 3))
        machine_loops.add_learned(
            data.setup,
            self._bases,
            np.ascontiguousarray(position_mm),
            np.ascontiguousarray(estimate),
            weight,
            of_fix,
            of_parameters,
            of_base,
            made_good,
            excess_mm2,
            position,
            sigma,
        )
        return position, sigma

    def _locate(
        self,
        data: ChainData,
        column: Floats,
        shift_mm: Floats | None,
        sigma_mm: Floats,
        rates: Floats,
        variance: Floats,
        *,
        wanted: bool,
    ) -> tuple[Located, Floats, Floats]:
        n, m = len(data), len(variance)
        out = Located(
            np.empty((n, 3)),
            np.empty((n, 3)),
            np.empty((n, self._rows + 1, 3)),
            np.empty((n, 3, self._joints)),
            np.empty((n if wanted else 0, 3, self._size)),
        )
        of_fix, of_parameters = np.empty((m, 3, 3)), np.empty((m, 3, 3))
        machine_loops.locate(
            np.ascontiguousarray(data.readings, dtype=np.float64),
            data.prism,
            data.setup,
            *self._tables,
            np.ascontiguousarray(column),
            np.empty((n, 3, 0)) if shift_mm is None else np.ascontiguousarray(shift_mm),
            np.ascontiguousarray(sigma_mm),
            np.ascontiguousarray(rates),
            np.ascontiguousarray(variance),
            *out,
            of_fix,
            of_parameters,
        )
        return out, of_fix, of_parameters


class Carrier:
    """A chain at parameters that stay, with points at which weights hang; where its bases stand plays no part.

    Args:
        chain: kinematics.
        x: (p,) its parameters.
        frames: of the points.
        offsets_mm: (m, 3) of the points in them.
    """

    def __init__(self, chain: Chain, x: Floats, frames: Sequence[int], offsets_mm: Floats) -> None:
        offsets = np.ascontiguousarray(offsets_mm, dtype=np.float64)
        self._tables = *_transforms(chain, x), np.array(frames, dtype=np.intp), offsets

    def work(self, readings: Floats, force: Floats, direction: Floats) -> Floats:
        """(n, joints) work of forces on the points per unit of each reading, force unit times mm per deg or mm.

        Args:
            readings: (n, joints) deg or mm.
            force: (n, m) at the points; (1, m) for all rows alike.
            direction: (n, 3) along which the forces act, unit vectors of the base frame; (1, 3) for all rows alike.
        """
        out, along = np.empty(readings.shape), np.ascontiguousarray(direction)
        machine_loops.work(np.ascontiguousarray(readings), np.ascontiguousarray(force), along, *self._tables, out)
        return out

    def places_mm(self, readings: Floats) -> Floats:
        """(n, m, 3) where the points are, in the base frame, for readings (n, joints)."""
        out = np.empty((len(readings), len(self._tables[-1]), 3))
        machine_loops.places(np.ascontiguousarray(readings), *self._tables, out)
        return out


def root_of(covariance: Floats) -> Floats:
    """(q, q) a root of a covariance that may be singular: root @ root' is the covariance."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0.0] = 1.0
    value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
    root: Floats = scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
    return root


def _triangular(root: Floats) -> Floats:
    """(q, q) the lower triangular root of the same covariance."""
    return np.ascontiguousarray(np.linalg.qr(root.T).R.T)


def _transforms(chain: Chain, x: Floats) -> Transforms:
    ops = [op for row in chain.row_ops for op in row]
    drives = [drive for op in ops for drive in op.drive]
    size = np.array([op.constant + (x[op.parameter] if op.parameter >= 0 else 0.0) for op in ops], dtype=np.float64)
    paths = [chain.rig.path(number) for number in range(1, len(chain.row_ops) + 1)]
    return Transforms(
        np.array([(op.rotates, op.axis, op.parameter) for op in ops], dtype=np.intp).reshape(-1, 3),
        np.column_stack([size, np.cos(size), np.sin(size)]),
        np.array(list(accumulate((len(op.drive) for op in ops), initial=0)), dtype=np.intp),
        np.array([joint for joint, _ in drives], dtype=np.intp),
        np.array([amount for _, amount in drives], dtype=np.float64),
        np.array(list(accumulate(map(len, chain.row_ops), initial=0)), dtype=np.intp),
        np.array([path[-2] if len(path) > 1 else 0 for path in paths], dtype=np.intp),
    )


def _points(chain: Chain, frames: Sequence[int], offsets_mm: Floats) -> Points:
    first = list(accumulate(map(len, chain.row_ops), initial=0))
    paths = [
        [
            first[number - 1] + i
            for number in chain.rig.path(frame)
            for i, op in enumerate(chain.row_ops[number - 1])
            if op.parameter >= 0 or op.drive
        ]
        for frame in frames
    ]
    return Points(
        np.array(frames, dtype=np.intp),
        np.asarray(offsets_mm, dtype=np.float64).reshape(-1, 3),
        np.array(list(accumulate(map(len, paths), initial=0)), dtype=np.intp),
        np.array([k for path in paths for k in path], dtype=np.intp),
    )


def _base(chain: Chain, x: Floats, setup: int) -> Floats:
    """(7, 3) rotation, origin, and the lines through the origin about which rz, ry and rx turn."""
    base, turned, lines = chain.base(x, setup), np.eye(3), []
    for axis, angle in zip((Z, Y, X), x[chain.base_index(setup)][3:].tolist(), strict=True):
        lines.append(turned[:, axis])
        turned = turned @ rotation_about(axis, angle)
    return np.vstack([base.rotation, base.translation_mm, lines])
