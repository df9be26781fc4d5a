"""Kinematics of any rig as a sequence of elementary transforms, with analytic Jacobians.

Every convention, coupling, fixed transform, base placement and prism offset becomes a list of rotations about and
translations along x, y or z. Forward kinematics, both Jacobians and the compiled kernel are written once, over that
list. For an elementary transform with axis u through origin o, a point P beyond it moves by u x (P - o) per rad of a
rotation and by u per mm of a translation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.observations import Floats, Observations
from calibration.rig import Convention, Rig, Row, RowParameter

Integers = NDArray[np.intp]

X, Y, Z = 0, 1, 2
_ANGLES: frozenset[RowParameter] = frozenset({"alpha", "theta", "beta"})
ROW_ORDER: Mapping[Convention, tuple[tuple[RowParameter, int], ...]] = {
    "mdh_beta_after": (("a", X), ("alpha", X), ("d", Z), ("theta", Z), ("beta", Y)),
    "mdh_beta_before": (("alpha", X), ("a", X), ("beta", Y), ("b", Y), ("theta", Z), ("d", Z)),
    "dh": (("theta", Z), ("d", Z), ("a", X), ("alpha", X), ("beta", Y)),
}
BASE_COMPONENTS = ("x", "y", "z", "rz", "ry", "rx")


@dataclass(frozen=True)
class Parameter:
    """One constant of the chain, as a deviation from its nominal value.

    Attributes:
        name: `row4.theta`, `prism.r.y`, `base[s1].rx` (`base.rx` where set-ups have no name).
        unit: `mm` or `rad`.
        prior_sigma: build tolerance, 1 sigma, in `unit`; infinity for what nobody knows beforehand (base placements,
            prisms whose mounting is unknown).
        kind: which part of the rig it belongs to.
    """

    name: str
    unit: Literal["mm", "rad"]
    prior_sigma: float
    kind: Literal["row", "prism", "base"]

    @property
    def is_flat(self) -> bool:
        """True where no build tolerance limits the parameter."""
        return math.isinf(self.prior_sigma)


@dataclass(frozen=True)
class Op:
    """One elementary transform: rotation about (rad) or translation along (mm) a coordinate axis.

    Its size is constant + parameter + sum of coefficient * reading over `drive`.

    Attributes:
        rotates: True for a rotation.
        axis: 0, 1, 2 for x, y, z.
        constant: nominal size.
        parameter: index of the deviation to identify, -1 for none.
        drive: (joint index, rad or mm per deg or mm of its reading).
    """

    rotates: bool
    axis: int
    constant: float = 0.0
    parameter: int = -1
    drive: tuple[tuple[int, float], ...] = ()

    @property
    def is_identity(self) -> bool:
        """True where the transform never does anything."""
        return self.constant == 0.0 and self.parameter < 0 and not self.drive

    def driven(self, readings: Floats) -> Floats:
        """(n,) constant and driven part of the size for (n, joints) readings."""
        size = np.full(len(readings), self.constant)
        for joint, coefficient in self.drive:
            size += coefficient * readings[:, joint]
        return size


@dataclass(frozen=True)
class Placement:
    """Where the base of a rig stands in a station's frame: P_station = rotation @ P_base + translation_mm."""

    rotation: Floats
    translation_mm: Floats

    @classmethod
    def identity(cls) -> Placement:
        """The base frame is the station's frame."""
        return cls(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class ChainData:
    """Observations bound to a chain.

    Attributes:
        readings: (n, joints), deg or mm, in the rig's order of joints.
        prism: (n,) index of each fix's prism.
        setup: (n,) index of each fix's set-up.
    """

    readings: Floats
    prism: Integers
    setup: Integers

    def __len__(self) -> int:
        return len(self.prism)

    def select(self, rows: NDArray[np.bool_] | Integers) -> ChainData:
        """The given rows, by mask or by index."""
        return ChainData(self.readings[rows], self.prism[rows], self.setup[rows])


class Linearisation(NamedTuple):
    """Positions with their derivatives.

    Attributes:
        position_mm: (n, 3) in the station's frame.
        jacobian: (n, 3, p) by parameter, mm per mm or rad.
        joint_jacobian: (n, 3, joints) by reading, mm per deg or mm.
    """

    position_mm: Floats
    jacobian: Floats
    joint_jacobian: Floats


# Axes of a frame and its origin: arrays (3, m).
_Frame = tuple[list[Floats], Floats]


class _Visited(NamedTuple):
    op: Op
    axis: Floats  # (3, m) in the station's frame
    origin: Floats  # (3, m)


class Chain:
    """Forward kinematics of a rig at one or more station set-ups.

    Args:
        rig: the rig description.
        placements: set-up -> where the base stands; base parameters are deviations from it.

    Attributes:
        parameters: every identifiable constant; the vector `x` of all methods has their order.
        joint_index: name of a joint -> its column among the readings.
        row_ops: per row its elementary transforms.
        prism_ops: per prism its three offset translations.
    """

    def __init__(self, rig: Rig, placements: Mapping[str, Placement]) -> None:
        self.rig = rig
        self.placements = dict(placements)
        self.setups = tuple(placements)
        self.joint_index = {name: index for index, name in enumerate(rig.joint_names)}
        self._prism_index = {name: index for index, name in enumerate(rig.prism_names)}
        self._setup_index = {name: index for index, name in enumerate(self.setups)}
        self._parameters: list[Parameter] = []
        self.row_ops = [
            [op for op in self._row_ops(number, row) if not op.is_identity] for number, row in enumerate(rig.rows, 1)
        ]
        self.prism_ops = [self._prism_ops(name) for name in rig.prism_names]
        self.base_start = len(self._parameters)
        for setup in self.setups:
            label = f"base[{setup}]" if setup else "base"
            for component in BASE_COMPONENTS:
                unit: Literal["mm", "rad"] = "rad" if component.startswith("r") else "mm"
                self._parameters.append(Parameter(f"{label}.{component}", unit, math.inf, "base"))
        self.parameters = tuple(self._parameters)
        self._rotation0 = np.array([p.rotation for p in placements.values()]).reshape(-1, 3, 3)
        self._translation0 = np.array([p.translation_mm for p in placements.values()]).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def prior_sigma(self) -> Floats:
        """(p,) build tolerances; infinity where there is none."""
        return np.array([p.prior_sigma for p in self.parameters])

    def with_tolerances(self, sigma: Mapping[str, float]) -> Chain:
        """The same kinematics with other tolerances, mm or rad, for the parameters named."""
        chain = copy(self)
        chain.parameters = tuple(replace(p, prior_sigma=sigma.get(p.name, p.prior_sigma)) for p in self.parameters)
        return chain

    def of(self, rig: Rig) -> Chain:
        """The kinematics of another description on the same bases; parameters that both have keep their tolerances."""
        return Chain(rig, self.placements).with_tolerances({p.name: p.prior_sigma for p in self.parameters})

    def index(self, name: str) -> int:
        """Index of the parameter called `name`; ValueError if there is none."""
        return [p.name for p in self.parameters].index(name)

    def base_index(self, setup: int) -> slice:
        """Where the six parameters of a set-up's base are."""
        return slice(self.base_start + 6 * setup, self.base_start + 6 * setup + 6)

    # -- construction -------------------------------------------------------------------------------------------

    def _add(self, name: str, *, angle: bool, sigma: float, kind: Literal["row", "prism"]) -> int:
        self._parameters.append(Parameter(name, "rad" if angle else "mm", sigma, kind))
        return len(self._parameters) - 1

    def _row_ops(self, number: int, row: Row) -> Iterator[Op]:
        if row.before is not None:
            fixed = row.before
            for axis, length in ((X, fixed.x_mm), (Y, fixed.y_mm), (Z, fixed.z_mm)):
                yield Op(False, axis, length)
            for axis, angle in ((Z, fixed.rz_deg), (Y, fixed.ry_deg), (X, fixed.rx_deg)):
                yield Op(True, axis, math.radians(angle))
        tolerances = self.rig.tolerances
        joints = self.rig.joint_names
        for constant, axis in ROW_ORDER[self.rig.convention]:
            angle_like = constant in _ANGLES
            nominal = getattr(row, f"{constant}_deg" if angle_like else f"{constant}_mm")
            scale = math.radians(1.0) if angle_like else 1.0
            tolerance = tolerances.beta_deg if constant == "beta" else tolerances.angle_deg
            sigma = math.radians(tolerance) if angle_like else tolerances.length_mm
            parameter = -1
            if constant in row.identify:
                parameter = self._add(f"row{number}.{constant}", angle=angle_like, sigma=sigma, kind="row")
            drive = next((c for driven, c in row.drive.items() if driven == constant), {})
            coupled = tuple((joints.index(name), coefficient * scale) for name, coefficient in drive.items())
            yield Op(angle_like, axis, nominal * scale, parameter, coupled)

    def _prism_ops(self, name: str) -> list[Op]:
        prism = self.rig.prism(name)
        sigma = self.rig.tolerances.prism_mm if prism.offset_known else math.inf
        return [
            Op(False, axis, offset, self._add(f"prism.{name}.{'xyz'[axis]}", angle=False, sigma=sigma, kind="prism"))
            for axis, offset in enumerate(prism.offset_mm)
        ]

    def frame_chain(self, frame: int) -> list[Op]:
        """The transforms from the base to the frame after a row (0: the base itself)."""
        return [op for number in self.rig.path(frame) for op in self.row_ops[number - 1]]

    def prism_chain(self, prism: int) -> list[Op]:
        """The transforms from the base to a prism."""
        return self.frame_chain(self.rig.prisms[prism].frame) + self.prism_ops[prism]

    # -- binding ------------------------------------------------------------------------------------------------

    def bind(self, observations: Observations) -> ChainData:
        """Look up prisms and set-ups.

        Raises:
            DataError: a prism that the rig lacks, a set-up without a placement, a joint without readings or with one
                that is no number.
        """
        try:
            readings = np.array([observations.joints[name] for name in self.joint_index], dtype=np.float64)
        except KeyError:
            lacking = min(self.joint_index.keys() - observations.joints.keys())
            raise DataError("observations", f"joint {lacking} is missing; are they another rig's?") from None
        if not np.isfinite(readings).all():
            joint, row = np.argwhere(~np.isfinite(readings))[0]
            column = self.rig.joints[joint].column
            raise DataError("observations", f"the reading of row {row} (from 0) is not a finite number", column=column)
        return ChainData(
            np.ascontiguousarray(readings.T),
            _indices(observations.prism.tolist(), self._prism_index, "prism"),
            _indices(observations.setup.tolist(), self._setup_index, "set-up"),
        )

    # -- evaluation ---------------------------------------------------------------------------------------------

    def base(self, x: Floats, setup: int) -> Placement:
        """Where the base stands at a set-up, with the deviations of `x` applied."""
        deviation = x[self.base_index(setup)]
        rotation = np.eye(3)
        for axis, angle in zip((Z, Y, X), deviation[3:], strict=True):
            rotation = rotation @ rotation_about(axis, float(angle))
        return Placement(rotation @ self._rotation0[setup], self._translation0[setup] + deviation[:3])

    def base_values(self, setup: int, wanted: Placement) -> Floats:
        """(6,) base parameters of a set-up with which its base stands as wanted: the inverse of `base`."""
        r = wanted.rotation @ self._rotation0[setup].T
        pitch = -math.asin(min(1.0, max(-1.0, float(r[2, 0]))))
        angles = math.atan2(r[1, 0], r[0, 0]), pitch, math.atan2(r[2, 1], r[2, 2])
        values: Floats = np.concatenate([wanted.translation_mm - self._translation0[setup], angles])
        return values

    def positions_mm(self, x: Floats, data: ChainData) -> Floats:
        """(n, 3) prism positions in the station's frame for parameters `x` (p,)."""
        position = np.empty((len(data), 3))
        for prism, rows in _groups(data.prism):
            position[rows] = self._visit(x, data, rows, self.prism_chain(prism), []).T
        return position

    def jacobian(self, x: Floats, data: ChainData) -> Floats:
        """(n, 3, p) derivatives by the parameters, mm per mm or rad."""
        return self.linearise(x, data).jacobian

    def joint_jacobian(self, x: Floats, data: ChainData) -> Floats:
        """(n, 3, joints) derivatives by the readings, mm per deg or mm."""
        return self.linearise(x, data).joint_jacobian

    def linearise(self, x: Floats, data: ChainData) -> Linearisation:
        """Positions and both Jacobians in one pass."""
        n = len(data)
        position = np.empty((n, 3))
        jacobian = np.zeros((n, 3, len(self)))
        by_joint = np.zeros((n, 3, len(self.rig.joints)))
        for prism, rows in _groups(data.prism):
            visited: list[_Visited] = []
            point = self._visit(x, data, rows, self.prism_chain(prism), visited)
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
        origins = np.empty((len(data), len(self.rig.rows), 3))
        ends = [self._start(x, data, None)]
        for number, ops in enumerate(self.row_ops, 1):
            before = ends[self.rig.path(number)[-2] if len(self.rig.path(number)) > 1 else 0]
            *_, end = self._walk(x, data.readings, ops, before)
            ends.append(end)
            origins[:, number - 1] = end[1].T
        return origins

    def _base_jacobian(self, x: Floats, data: ChainData, rows: Integers, point: Floats, jacobian: Floats) -> None:
        """The base deviates by Trans(x, y, z) Rot(z) Rot(y) Rot(x) in front of its placement."""
        for setup, own in _groups(data.setup[rows]):
            index = self.base_index(setup)
            base = self.base(x, setup)
            target = rows[own]
            jacobian[target, :, index.start : index.start + 3] = np.eye(3)
            arm = point[:, own] - base.translation_mm[:, None]
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
        bases = [self.base(x, s) for s in range(len(self.setups))]
        rotation = np.array([b.rotation for b in bases])
        columns = [np.ascontiguousarray(rotation[:, :, axis][setup].T) for axis in (X, Y, Z)]
        return columns, np.ascontiguousarray(np.array([b.translation_mm for b in bases])[setup].T)

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


def rotation_about(axis: int, angle_rad: float) -> Floats:
    """(3, 3) rotation about coordinate axis 0, 1 or 2."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[u, u] = out[v, v] = c
    out[v, u], out[u, v] = s, -s
    return out


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product of (3, m) arrays; several times faster than `np.cross` along the first axis."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _groups(labels: Integers) -> Iterator[tuple[int, Integers]]:
    """Every label that occurs with its rows."""
    for label in np.unique(labels):
        yield int(label), np.flatnonzero(labels == label)


def _indices(labels: Sequence[str], index: Mapping[str, int], what: str) -> Integers:
    try:
        return np.array([index[label] for label in labels], dtype=np.intp)
    except KeyError:
        first, known = min(set(labels) - set(index)), ", ".join(map(repr, index))
        raise DataError("observations", f"{what} {first!r} is unknown; known: {known}") from None
