"""Effects as columns of a linear model: the change of joint values and prisms per unit of each coefficient."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import ChainData, Linearisation
from calibration.observations import Floats

Integers = NDArray[np.intp]

NO_JOINT = -1
_NEARLY = 1e-5
_FEW = 50  # up to this number, coefficients are summed by one small matrix product in spite of its many zeros


@dataclass(frozen=True)
class EffectColumns:
    """k coefficients in addition to the parameters of a chain, for m rows.

    Coefficient i adds `column[:, i]` times its value to the reading of joint `joint[i]`, before couplings. It also adds
    `shift_mm[:, :, i]` times its value to the prism positions that the kinematics compute from the changed readings.

    Attributes:
        names: names of the coefficients, `family@where:name`.
        joint: (k,) index of the joint that each coefficient changes, `NO_JOINT` for none.
        column: (m, k) change of that joint per unit of the coefficient, deg or mm; zero without a joint.
        prior_sigma: (k,) plausible size of each coefficient, 1 sigma, in its unit.
        shift_mm: (m, 3, k) displacement in the station's frame per unit of the coefficient; None if no coefficient
            moves a prism directly.
    """

    names: tuple[str, ...]
    joint: Integers
    column: Floats
    prior_sigma: Floats
    shift_mm: Floats | None = None

    def __len__(self) -> int:
        return len(self.joint)

    def apply(self, data: ChainData, coefficients: Floats) -> tuple[ChainData, Floats]:
        """Apply the effects to rows of observations.

        Args:
            data: m rows with the original readings.
            coefficients: (k,) values.

        Returns:
            The rows with corrected joint values, for the kinematics; and (m, 3) displacements in the station's frame,
            to be added to the positions that the kinematics compute.
        """
        shift_mm = self.shifted_mm(coefficients)
        return (data.moved(self.change(coefficients, data.readings.shape[1])) if self.joint.size else data), shift_mm

    def linearise(
        self, kinematics: Callable[[ChainData], Linearisation], data: ChainData, coefficients: Floats
    ) -> Linearisation:
        """Linearise kinematics and effects together.

        Args:
            kinematics: function from m rows to positions in the station's frame, with derivatives by p parameters.
            data: m rows with the original readings.
            coefficients: (k,) values.

        Returns:
            Positions with the effects applied; the last k columns of the Jacobian (m, 3, p + k) are by coefficients.
        """
        moved, shift_mm = self.apply(data, coefficients)
        lin = kinematics(moved)
        p = lin.jacobian.shape[2]
        jacobian = np.empty((*lin.jacobian.shape[:2], p + len(self)))
        jacobian[:, :, :p] = lin.jacobian
        self._move(lin.joint_jacobian, jacobian[:, :, p:])
        return Linearisation(lin.position_mm + shift_mm, jacobian, lin.joint_jacobian)

    def change(self, coefficients: Floats, joints: int) -> Floats:
        """Return the change of all readings, (m, joints), deg or mm.

        Args:
            coefficients: (k,) values.
            joints: number of joints of the rig.
        """
        if self.joint.size <= _FEW:
            few: Floats = self.column @ _by_joint(self.joint.tobytes(), coefficients.tobytes(), joints)
            return few
        out = np.zeros((self.rows, joints))
        for joint, own in _runs(self.joint.tobytes()):
            out[:, joint] += self.column[:, own] @ coefficients[own]
        return out

    def shifted_mm(self, coefficients: Floats) -> Floats:
        """Return the direct displacement of the prisms, (m, 3) in the station's frame, for coefficients (k,)."""
        if self.shift_mm is None:
            return np.zeros((self.rows, 3))
        shifted: Floats = self.shift_mm[:, :, self._shifting] @ coefficients[self._shifting]
        return shifted

    def moved_mm(self, joint_jacobian: Floats) -> Floats:
        """Return the total displacement (m, 3, k) of the prisms per unit of each coefficient.

        Args:
            joint_jacobian: (m, 3, joints) derivatives of the positions by readings, mm per deg or mm.
        """
        moved = np.empty((self.rows, 3, len(self)))
        self._move(joint_jacobian, moved)
        return moved

    def _move(self, joint_jacobian: Floats, out: Floats) -> None:
        """Write `moved_mm` into `out` (m, 3, k)."""
        for joint, own in _runs(self.joint.tobytes()):
            np.multiply(joint_jacobian[:, :, joint, None], self.column[:, None, own], out=out[:, :, own])
        if self.shift_mm is not None:
            out[:, :, self._shifting] += self.shift_mm[:, :, self._shifting]

    @cached_property
    def sums(self) -> tuple[int, float, float]:
        """Number of coefficients and sums of their columns: a quick check for different sets."""
        return len(self), float(self.column.sum()), 0.0 if self.shift_mm is None else float(self.shift_mm.sum())

    @property
    def rows(self) -> int:
        """Number of rows m."""
        return len(self.column)

    def has_columns_of(self, other: EffectColumns) -> bool:
        """Return True if both sets share the same arrays in memory."""
        return self.column is other.column and self.shift_mm is other.shift_mm

    def with_columns_of(self, other: EffectColumns) -> EffectColumns:
        """Return the coefficients with the arrays of another set, whose values are equal."""
        return replace(self, column=other.column, shift_mm=other.shift_mm)

    @cached_property
    def _shifting(self) -> slice:
        """Slice from the first to the last coefficient that moves a prism directly."""
        found = np.flatnonzero([] if self.shift_mm is None else self.shift_mm.any(axis=(0, 1)))
        return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)

    def over(self, rows: Callable[[Floats], Floats]) -> EffectColumns:
        """Return the same coefficients for other rows.

        Args:
            rows: function from values (m, ...) of these rows to values (m', ...) of the others, such as a mean.
        """
        shift = None if self.shift_mm is None else rows(self.shift_mm)
        return replace(self, column=rows(self.column), shift_mm=shift)

    def select(self, rows: NDArray[np.bool_] | Integers) -> EffectColumns:
        """Return the same coefficients for the given rows, by mask or by index."""
        return self.over(lambda values: values[rows])


def joined(parts: Sequence[EffectColumns], rows: int) -> EffectColumns:
    """Concatenate the coefficients of several effects.

    Args:
        parts: coefficients of each effect, all for the same rows.
        rows: number of rows; needed where there are no parts.
    """
    shift = None
    if any(part.shift_mm is not None for part in parts):
        zero = [np.zeros((rows, 3, len(part))) if part.shift_mm is None else part.shift_mm for part in parts]
        shift = np.concatenate(zero, axis=2)
    return EffectColumns(
        tuple(name for part in parts for name in part.names),
        np.concatenate([np.empty(0, dtype=np.intp), *(part.joint for part in parts)]),
        np.hstack([np.empty((rows, 0)), *(part.column for part in parts)]),
        np.concatenate([np.empty(0), *(part.prior_sigma for part in parts)]),
        shift,
    )


def same_columns(a: EffectColumns, b: EffectColumns) -> bool:
    """Return True if two sets of coefficients differ only in names and priors."""
    if not np.array_equal(a.joint, b.joint):
        return False
    if a.has_columns_of(b):
        return True
    if not np.array_equal(a.column, b.column):
        return False
    if a.shift_mm is None or b.shift_mm is None:
        return a.shift_mm is b.shift_mm
    return np.array_equal(a.shift_mm, b.shift_mm)


def nearly_same(a: EffectColumns, b: EffectColumns) -> bool:
    """Return True if two forms of the same coefficients differ by at most 1e-5 of the largest value."""
    if a.shift_mm is None or b.shift_mm is None:
        return _nearly_equal(a.column, b.column)
    return _nearly_equal(a.column, b.column) and _nearly_equal(a.shift_mm, b.shift_mm)


def _nearly_equal(one: Floats, other: Floats) -> bool:
    largest = float(np.abs(one).max(initial=0.0))
    return bool(np.abs(other - one).max(initial=0.0) <= _NEARLY * largest)


def sharing(parts: Iterable[EffectColumns], known: Iterable[EffectColumns] = ()) -> tuple[EffectColumns, ...]:
    """Return the same coefficients with equal columns shared in memory: with thousands of rows they take megabytes.

    Args:
        parts: sets of coefficients.
        known: further sets whose arrays may be reused.
    """
    kept: dict[tuple[int, float, float], list[EffectColumns]] = {}
    for part in known:
        kept.setdefault(part.sums, []).append(part)
    out = []
    for part in parts:
        alike = kept.setdefault(part.sums, [])
        same = next((other for other in alike if same_columns(other, part)), None)
        if same is None:
            alike.append(part)
            out.append(part)
        else:
            out.append(part if part.has_columns_of(same) else part.with_columns_of(same))
    return tuple(out)


@lru_cache
def _by_joint(joints: bytes, coefficients: bytes, count: int) -> Floats:
    """Return (k, count): each coefficient at its joint, else 0; cached for a model that predicts row by row."""
    at = np.frombuffer(joints, dtype=np.intp)[:, None] == np.arange(count)
    return np.where(at, np.frombuffer(coefficients)[:, None], 0.0)


@lru_cache
def _runs(joints: bytes) -> tuple[tuple[int, slice], ...]:
    """Return each run of coefficients at one joint: the joint's index, and a slice, which avoids copies.

    Coefficients without a joint have zero columns, so it does not matter which joint `NO_JOINT` indexes.
    """
    joint = np.frombuffer(joints, dtype=np.intp)
    edges = [0, *(np.flatnonzero(np.diff(joint)) + 1).tolist(), len(joint)]
    return tuple((int(joint[a]), slice(a, b)) for a, b in itertools.pairwise(edges) if a < b)
