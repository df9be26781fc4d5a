"""Effects as linear columns: what a coefficient of each does to the joint values and to the prism of each row."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Integers = NDArray[np.intp]

NO_JOINT = -1


@dataclass(frozen=True)
class Additions:
    """k coefficients that a fit estimates along with the parameters of the chain, for m rows.

    The true value of joint `joint[i]` is its reading plus `column[:, i]` times coefficient i, before couplings; and the
    prism is `shift_mm[:, :, i]` times coefficient i away from where the kinematics have it then.

    Attributes:
        names: of the coefficients, `family@where:name`.
        joint: (k,) index of the joint that each changes, `NO_JOINT` for none.
        column: (m, k) deg or mm of that joint per unit of the coefficient; zero where there is none.
        prior_sigma: (k,) plausible size of each coefficient, 1 sigma, in its unit.
        shift_mm: (m, 3, k) in the station's frame, per unit of the coefficient; None where none moves a prism itself.
    """

    names: tuple[str, ...]
    joint: Integers
    column: Floats
    prior_sigma: Floats
    shift_mm: Floats | None = None

    def __len__(self) -> int:
        return len(self.joint)

    def change(self, coefficients: Floats, joints: int) -> Floats:
        """(m, joints) by what coefficients (k,) change the readings, deg or mm."""
        out = np.zeros((len(self.column), joints))
        for joint, own in self._runs:
            out[:, joint] += self.column[:, own] @ coefficients[own]
        return out

    def shifted_mm(self, coefficients: Floats) -> Floats:
        """(m, 3) by what coefficients (k,) move the prism beside that, in the station's frame."""
        if self.shift_mm is None:
            return np.zeros((len(self.column), 3))
        shifted: Floats = self.shift_mm @ coefficients
        return shifted

    def moved_mm(self, joint_jacobian: Floats) -> Floats:
        """(m, 3, k) what unit coefficients move, for the (m, 3, joints) Jacobian by readings in mm per deg or mm."""
        moved = np.empty((len(self.column), 3, len(self)))
        for joint, own in self._runs:
            np.multiply(joint_jacobian[:, :, joint, None], self.column[:, None, own], out=moved[:, :, own])
        if self.shift_mm is not None:
            moved += self.shift_mm
        return moved

    @cached_property
    def _runs(self) -> tuple[tuple[int, slice], ...]:
        """Joints with the coefficients at each that follow one another: slices, which copy nothing.

        The columns of those at none are zero, whichever joint `NO_JOINT` is taken for.
        """
        edges = [0, *(np.flatnonzero(np.diff(self.joint)) + 1).tolist(), len(self)]
        return tuple((int(self.joint[a]), slice(a, b)) for a, b in itertools.pairwise(edges) if a < b)

    def over(self, rows: Callable[[Floats], Floats]) -> Additions:
        """The same coefficients for other rows, `rows` making theirs (m', ...) of what these have (m, ...)."""
        shift = None if self.shift_mm is None else rows(self.shift_mm)
        return replace(self, column=rows(self.column), shift_mm=shift)

    def select(self, rows: NDArray[np.bool_] | Integers) -> Additions:
        """The same coefficients for the given rows, by mask or by index."""
        return self.over(lambda values: values[rows])


def joined(parts: Sequence[Additions], rows: int) -> Additions:
    """All coefficients of several effects, for `rows` observations."""
    shift = None
    if any(part.shift_mm is not None for part in parts):
        zero = [np.zeros((rows, 3, len(part))) if part.shift_mm is None else part.shift_mm for part in parts]
        shift = np.concatenate(zero, axis=2)
    return Additions(
        tuple(name for part in parts for name in part.names),
        np.concatenate([np.empty(0, dtype=np.intp), *(part.joint for part in parts)]),
        np.hstack([np.empty((rows, 0)), *(part.column for part in parts)]),
        np.concatenate([np.empty(0), *(part.prior_sigma for part in parts)]),
        shift,
    )


def same_columns(a: Additions, b: Additions) -> bool:
    """Whether two sets of coefficients differ in their names and priors alone."""
    shifts = (a.shift_mm, b.shift_mm)
    if not (np.array_equal(a.joint, b.joint) and np.array_equal(a.column, b.column)):
        return False
    return shifts[0] is shifts[1] or (
        shifts[0] is not None and shifts[1] is not None and np.array_equal(shifts[0], shifts[1])
    )
