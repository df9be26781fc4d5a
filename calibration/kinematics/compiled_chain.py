"""A chain with fixed parameters: positions of its prisms and frames, derivatives, and the uncertainty of a fix.

The covariances of fixes are the same as in `calibration.identification.samples`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from calibration.kinematics import chain_loops, fix_loops
from calibration.kinematics.chain import Chain, ChainData, Integers
from calibration.numerics.matrices import root_of, triangular
from calibration.observations import Floats

_NOTHING: Floats = np.empty((0, 0))
_NONE: Integers = np.empty(0, dtype=np.intp)


class Located(NamedTuple):
    """Positions of prisms and frames in n rows.

    Attributes:
        position_mm: (n, 3) prisms in the station's frame.
        prism_mm: (n, 3) prisms in the base frame.
        frames_mm: (n, rows + 1, 3) origins of the base frame and of the frame after each row, in the base frame.
        joint_jacobian: (n, 3, joints) derivatives by readings in the base frame, mm per deg or mm.
        jacobian: (n, 3, p + k) derivatives by parameters and coefficients in the base frame, mm per unit; no rows if
            not requested.
    """

    position_mm: Floats
    prism_mm: Floats
    frames_mm: Floats
    joint_jacobian: Floats
    jacobian: Floats


class Facing(NamedTuple):
    """Orientation of prisms and their displacement by each drive, in n rows; all in the base frame.

    Attributes:
        axes: (n, 3, 3) axes of the prism's frame, as rows.
        by_drive: (n, 3, drives) derivatives through each drive of `CompiledChain.drives` alone, mm per deg or mm of
            the reading.
    """

    axes: Floats
    by_drive: Floats


class CompiledChain:
    """A chain with fixed parameters; build it once and evaluate any rows.

    Args:
        chain: kinematics.
        x: (p,) parameters of the chain.
        covariance: (p + k, p + k) covariance of the parameters and of coefficients of effects; zero by default.
        coefficient_joint: (k,) joint whose value each coefficient changes, -1 for none.
        repeat_sigma_mm: scatter of repeated fixes in excess of the station's sigma, per axis.

    Attributes:
        bases: (setups, 7, 3) bases from `chain_loops.place_bases`.
        drives: (row number from 1, index of the joint) of every drive; a coupled joint has several.
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
        root = np.zeros((len(chain), len(chain))) if covariance is None else triangular(root_of(covariance))
        self.bases = chain.bases(x)
        self._rows, self._joints, self._size = len(chain.rig.rows), len(chain.rig.joints), len(root)
        self.drives = tuple(
            (number, joint) for number, ops in enumerate(chain.row_ops, 1) for op in ops for joint, _ in op.drive
        )
        self._kinematics = chain.tables(x)
        self._tables = (
            *self._kinematics[0],
            *self._kinematics[1],
            self.bases,
            chain.base_start,
            root,
            coefficient_joint,
            (
                station.distance_sigma_mm,
                station.distance_sigma_ppm,
                math.radians(station.angle_sigma_arcsec / 3600.0),
                station.target_sigma_mm,
                repeat_sigma_mm,
                station.timing_sigma_s,
            ),
        )

    def rotations(self, data: ChainData) -> Floats:
        """Return the rotations (n, 3, 3) from the base frame to the station's."""
        return self.bases[data.setup, :3]

    def face(self, data: ChainData) -> Facing:
        """Return the orientation of the prisms of n rows, and their displacement by each drive."""
        out = Facing(np.empty((len(data), 3, 3)), np.empty((len(data), 3, len(self.drives))))
        readings = np.ascontiguousarray(data.readings, dtype=np.float64)
        chain_loops.face(readings, data.prism, *self._kinematics, *out)
        return out

    def locate(self, data: ChainData) -> Located:
        """Return the positions of n rows, without the Jacobian by parameters."""
        return self.spread(data, _NOTHING, None, _NOTHING, _NOTHING, _NOTHING, jacobian=False)[0]

    def linearise(self, data: ChainData, column: Floats | None = None, shift_mm: Floats | None = None) -> Located:
        """Return the positions of n rows with the Jacobian by parameters and coefficients.

        Args:
            data: n rows, with readings as corrected by the effects.
            column: (n, k) change of the joint per unit of each coefficient, deg or mm; not needed without coefficients.
            shift_mm: (n, 3, k) additional displacement in the base frame per unit of each coefficient.
        """
        column = np.empty((len(data), 0)) if column is None else column
        return self.spread(data, column, shift_mm, _NOTHING, _NOTHING, _NOTHING, jacobian=True)[0]

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
        """Return the positions of n rows with the covariance of a fix there.

        Args:
            data: as for `linearise`.
            column: as for `linearise`.
            shift_mm: as for `linearise`.
            sigma_mm: (n, 3) standard deviations of the fix, which replace the station's where finite.
            rates: (n, joints) deg/s or mm/s, NaN where not measured.
            variance: (n, joints) variance of each joint's value, deg^2 or mm^2.
            jacobian: whether to return the Jacobian by parameters and coefficients.

        Returns:
            The positions; the covariance (n, 3, 3) of the fix due to station, repeats, readings and timing; and the
            covariance (n, 3, 3) due to parameters and coefficients. Both are in mm^2, in the station's frame.
        """
        n, m = len(data), len(variance)
        out = Located(
            np.empty((n, 3)),
            np.empty((n, 3)),
            np.empty((n, self._rows + 1, 3)),
            np.zeros((n, 3, self._joints)),
            np.zeros((n if jacobian else 0, 3, self._size)),
        )
        of_fix, of_parameters = np.empty((m, 3, 3)), np.empty((m, 3, 3))
        fix_loops.locate(
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
