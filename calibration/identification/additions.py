"""Effects as linear columns: what a coefficient of each does to the joint values of each row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Additions:
    """k coefficients that a fit estimates along with the parameters of the chain, for m rows.

    The true value of joint `joint[i]` is its reading plus `column[:, i]` times coefficient i, before couplings.

    Attributes:
        names: of the coefficients, `family@where:name`.
        joint: (k,) index of the joint that each changes.
        column: (m, k) deg or mm of that joint per unit of the coefficient.
        prior_sigma: (k,) plausible size of each coefficient, 1 sigma, in its unit.
    """

    names: tuple[str, ...]
    joint: Integers
    column: Floats
    prior_sigma: Floats

    def __len__(self) -> int:
        return len(self.names)

    def change(self, coefficients: Floats, joints: int) -> Floats:
        """(m, joints) by what coefficients (k,) change the readings, deg or mm."""
        out = np.zeros((len(self.column), joints))
        for i, joint in enumerate(self.joint):
            out[:, joint] += self.column[:, i] * coefficients[i]
        return out

    def moved_mm(self, joint_jacobian: Floats) -> Floats:
        """(m, 3, k) what unit coefficients move, for the (m, 3, joints) Jacobian by readings in mm per deg or mm."""
        moved: Floats = joint_jacobian[:, :, self.joint] * self.column[:, None, :]
        return moved

    def select(self, rows: NDArray[np.bool_] | Integers) -> Additions:
        """The same coefficients for the given rows, by mask or by index."""
        return Additions(self.names, self.joint, self.column[rows], self.prior_sigma)
