"""Kinematics of any rig as a sequence of elementary transforms, with analytic Jacobians.

Every convention, coupling, fixed transform, base placement and prism offset becomes a list of rotations about and
translations along x, y or z. The compiled loops over that list (`chain_loops`) are the forward kinematics of all fits,
predictions and loads. Only the fitness of whole populations has its own (`fitness`), which is many times faster there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from copy import copy
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.kinematics import chain_loops
from calibration.kinematics.chain_loops import Points, Transforms
from calibration.observations import Floats, Observations
from calibration.rig.description import Convention, Rig, Row, RowParameter

Integers = NDArray[np.intp]

PLAIN: Sequence[Literal["C", "A", "W"]] = ("C", "A", "W")  # requirements for arrays that are passed to numba

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
        name: for example `row4.theta`, `prism.r.y`, `base[s1].rx` (`base.rx` if the set-up has no name).
        unit: `mm` or `rad`.
        prior_sigma: build tolerance, 1 sigma, in `unit`; infinity for constants that are not known beforehand (base
            placements, prisms whose mounting is unknown).
        kind: part of the rig to which it belongs.
    """

    name: str
    unit: Literal["mm", "rad"]
    prior_sigma: float
    kind: Literal["row", "prism", "base"]

    @property
    def is_flat(self) -> bool:
        """True if no build tolerance limits the parameter."""
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
        """True if the transform is always the identity."""
        return self.constant == 0.0 and self.parameter < 0 and not self.drive

    def driven(self, readings: Floats) -> Floats:
        """Return the (n,) size without its parameter for readings (n, joints)."""
        size = np.full(len(readings), self.constant)
        for joint, coefficient in self.drive:
            size += coefficient * readings[:, joint]
        return size


@dataclass(frozen=True)
class Placement:
    """Placement of a rig's base in a station's frame: P_station = rotation @ P_base + translation_mm.

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation_mm: (3,) position of the base frame's origin.
    """

    rotation: Floats
    translation_mm: Floats

    @classmethod
    def identity(cls) -> Placement:
        """Return the placement of a base whose frame is the station's."""
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

    def moved(self, change: Floats) -> ChainData:
        """Return the same rows with a change (n, joints), deg or mm, added to the readings."""
        return ChainData(self.readings + change, self.prism, self.setup)

    def select(self, rows: NDArray[np.bool_] | Integers) -> ChainData:
        """Return the given rows, by mask or by index."""
        return ChainData(self.readings[rows], self.prism[rows], self.setup[rows])


class Linearisation(NamedTuple):
    """Positions with their derivatives.

    Attributes:
        position_mm: (n, 3) positions in the station's frame.
        jacobian: (n, 3, p) derivatives by parameters, mm per mm or rad.
        joint_jacobian: (n, 3, joints) derivatives by readings, mm per deg or mm.
    """

    position_mm: Floats
    jacobian: Floats
    joint_jacobian: Floats


class _Tables:
    """Tables of transforms and prisms for the compiled loops.

    Args:
        runs: sequences of transforms; run number k ends in frame k.
        before: frame at which each run starts, 0 for the base.
        offsets: three translations of every prism.
        frames: frame to which every prism is fixed.
        paths: numbers of the runs between the base and each prism.
    """

    def __init__(
        self,
        runs: Sequence[Sequence[Op]],
        before: Sequence[int],
        offsets: Sequence[Sequence[Op]],
        frames: Sequence[int],
        paths: Sequence[Sequence[int]],
    ) -> None:
        ops = [op for run in runs for op in run]
        drives = [drive for op in ops for drive in op.drive]
        first = _starts(runs)
        passed = [[k for number in path for k in range(first[number - 1], first[number])] for path in paths]
        moving = [[k for k in own if ops[k].parameter >= 0 or ops[k].drive] for own in passed]
        self._nominal = np.array([op.constant for op in ops], dtype=np.float64)
        self._transforms = Transforms(
            np.array([(op.rotates, op.axis, op.parameter) for op in ops], dtype=np.intp).reshape(-1, 3),
            np.empty((len(ops), 3)),
            _starts(op.drive for op in ops),
            np.array([joint for joint, _ in drives], dtype=np.intp),
            np.array([size for _, size in drives], dtype=np.float64),
            first,
            np.array(before, dtype=np.intp),
        )
        self._points = Points(
            np.array(frames, dtype=np.intp),
            np.array([[op.constant for op in own] for own in offsets], dtype=np.float64),
            np.array([own[0].parameter for own in offsets], dtype=np.intp),
            _starts(moving),
            np.array([k for own in moving for k in own], dtype=np.intp),
        )
        self._offset_parameters = self._points.parameter[:, None] + np.arange(3)

    def at(self, x: Floats) -> tuple[Transforms, Points]:
        """Return the tables of transforms and prisms at parameters (p,)."""
        amount, nominal = np.empty((len(self._nominal), 3)), self._points
        chain_loops.settle(x, self._transforms.kind, self._nominal, amount)
        offset = nominal.offset + x[self._offset_parameters]
        return self._transforms._replace(amount=amount), nominal._replace(offset=offset)


class Chain:
    """Forward kinematics of a rig at one or more station set-ups.

    Args:
        rig: the rig description.
        placements: set-up -> placement of the base; base parameters are deviations from it.

    Attributes:
        parameters: every identifiable constant, in the order of the vector `x` of all methods.
        joint_index: name of a joint -> its column among the readings.
        row_ops: elementary transforms of each row.
        prism_ops: three offset translations of each prism.
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
        paths = [rig.path(number) for number in range(len(rig.rows) + 1)]
        own = [paths[prism.frame] for prism in rig.prisms]
        before = [(0, *path)[-2] for path in paths[1:]]
        self._tree = _Tables(self.row_ops, before, self.prism_ops, [prism.frame for prism in rig.prisms], own)
        # For positions of prisms alone, each path is one long row, so that no intermediate frames are stored.
        whole = [[op for number in path for op in self.row_ops[number - 1]] for path in own]
        numbers = range(1, len(whole) + 1)
        self._straight = _Tables(whole, [0] * len(whole), self.prism_ops, numbers, [(number,) for number in numbers])
        self._rotations = np.array([p.rotation for p in placements.values()], dtype=np.float64).reshape(-1, 3, 3)
        self._translations_mm = np.array([p.translation_mm for p in placements.values()], dtype=np.float64).reshape(
            -1, 3
        )

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def prior_sigma(self) -> Floats:
        """(p,) build tolerances; infinity for parameters without one."""
        return np.array([p.prior_sigma for p in self.parameters])

    def with_tolerances(self, sigma: Mapping[str, float]) -> Chain:
        """Return the same kinematics with other tolerances, mm or rad, for the parameters named."""
        chain = copy(self)
        chain.parameters = tuple(replace(p, prior_sigma=sigma.get(p.name, p.prior_sigma)) for p in self.parameters)
        return chain

    def of(self, rig: Rig) -> Chain:
        """Return the kinematics of a different rig on the same bases; common parameters keep their tolerances."""
        return Chain(rig, self.placements).with_tolerances({p.name: p.prior_sigma for p in self.parameters})

    def index(self, name: str) -> int:
        """Return the index of the parameter called `name`; ValueError if there is none."""
        return [p.name for p in self.parameters].index(name)

    def base_index(self, setup: int) -> slice:
        """Return the indices of the six parameters of a set-up's base."""
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

    def prism_chain(self, prism: int) -> list[Op]:
        """Return the transforms from the base to a prism."""
        rows = self.rig.path(self.rig.prisms[prism].frame)
        return [op for number in rows for op in self.row_ops[number - 1]] + self.prism_ops[prism]

    # -- binding ------------------------------------------------------------------------------------------------

    def bind(self, observations: Observations) -> ChainData:
        """Bind observations to the chain: readings in its order of joints, indices of prisms and set-ups.

        Raises:
            DataError: the rig lacks a prism, a set-up has no placement, or a joint has no readings or one that is not
                finite.
        """
        try:
            readings = np.array([observations.joints[name] for name in self.joint_index], dtype=np.float64)
        except KeyError:
            lacking = min(self.joint_index.keys() - observations.joints.keys())
            raise DataError("observations", f"joint {lacking} is missing; do they belong to another rig?") from None
        if not np.isfinite(readings).all():
            joint, row = np.argwhere(~np.isfinite(readings))[0]
            column = self.rig.joints[joint].column
            place = observations.row_name(row)
            raise DataError("observations", f"the reading of {place} is not a finite number", column=column)
        return ChainData(
            np.ascontiguousarray(readings.T),
            _indices(observations.prism.tolist(), self._prism_index, "prism"),
            _indices(observations.setup.tolist(), self._setup_index, "set-up"),
        )

    # -- evaluation ---------------------------------------------------------------------------------------------

    def base(self, x: Floats, setup: int) -> Placement:
        """Return the placement of the base at a set-up, including the deviations in `x` (p,)."""
        own = self.bases(x)[setup]
        return Placement(own[:3], own[3])

    def base_values(self, setup: int, wanted: Placement) -> Floats:
        """Return the base parameters (6,) for a wanted placement of the base at a set-up: the inverse of `base`."""
        r = wanted.rotation @ self._rotations[setup].T
        pitch = -math.asin(min(1.0, max(-1.0, float(r[2, 0]))))
        angles = math.atan2(r[1, 0], r[0, 0]), pitch, math.atan2(r[2, 1], r[2, 2])
        values: Floats = np.concatenate([wanted.translation_mm - self._translations_mm[setup], angles])
        return values

    def positions_mm(self, x: Floats, data: ChainData) -> Floats:
        """Compute the prism positions.

        Args:
            x: (p,) parameters, mm and rad.
            data: n bound observations.

        Returns:
            (n, 3) mm in the station's frame.
        """
        return self._evaluate(x, data, 0).position_mm

    def linearise(self, x: Floats, data: ChainData) -> Linearisation:
        """Compute the prism positions with their derivatives by parameters and by readings.

        Args:
            x: (p,) parameters, mm and rad.
            data: n bound observations.
        """
        return self._evaluate(x, data, len(data))

    def _evaluate(self, x: Floats, data: ChainData, derived: int) -> Linearisation:
        """Compute the positions of all rows, and derivatives if `derived` is the number of rows and not 0."""
        out = Linearisation(
            np.empty((len(data), 3)),
            np.zeros((derived, 3, len(self))),
            np.zeros((derived, 3, len(self.joint_index))),
        )
        readings, x = np.require(data.readings, np.float64, PLAIN), np.require(x, np.float64, PLAIN)
        transforms, points = self._straight.at(x)
        tables = *transforms, *points, self.bases(x), self.base_start
        chain_loops.linearise(readings, data.prism, data.setup, *tables, *out)
        return out

    def tables(self, x: Floats) -> tuple[Transforms, Points]:
        """Return the tables of rows and prisms at parameters (p,), for the compiled loops."""
        return self._tree.at(np.require(x, np.float64, PLAIN))

    def bases(self, x: Floats) -> Floats:
        """Return (setups, 7, 3): rotation, origin, and the axes about which rz, ry and rx turn, of every base."""
        out = np.empty((len(self.setups), 7, 3))
        chain_loops.place_bases(
            np.require(x, np.float64, PLAIN), self._rotations, self._translations_mm, self.base_start, out
        )
        return out


def rotation_about(axis: int, angle_rad: float) -> Floats:
    """Return the rotation (3, 3) about coordinate axis 0, 1 or 2."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[u, u] = out[v, v] = c
    out[v, u], out[u, v] = s, -s
    return out


def _starts(lists: Iterable[Sized]) -> Integers:
    """Return the first index of each list in their concatenation, and the end of the last one."""
    return np.array(list(accumulate(map(len, lists), initial=0)), dtype=np.intp)


def _indices(labels: Sequence[str], index: Mapping[str, int], what: str) -> Integers:
    try:
        return np.array([index[label] for label in labels], dtype=np.intp)
    except KeyError:
        first, known = min(set(labels) - set(index)), ", ".join(map(repr, index))
        raise DataError("observations", f"{what} {first!r} is unknown; known: {known}") from None
