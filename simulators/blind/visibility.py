"""Visible size of a displacement: the part that a calibration of the machine's constants does not absorb.

Calibration fits a machine's constants, each within its build tolerance, and so imitates part of any effect. Let d be a
displacement of n fixes with noise covariance C, and let constants with derivatives J and tolerances P absorb a part of
it. Its visible part is Sigma^-1/2 d with Sigma = C + J P J'. In this space the noise has variance 1 in every direction,
and the RMS of the visible part over its 3 n components is the visible size of d in units of the noise.

Derivatives are differences of the simulator's own kinematics, so that this measure is independent of the analysis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simulators.rig.screws import Floats, RowConstants, pose_chain, screw_chain
from simulators.rig.truth import RigTruth

Strings = NDArray[np.str_]

_STEP = 1e-3  # share of a tolerance: differences stay linear, and far above rounding
_FREE_MM = 1e3  # for the position of a base or a prism that is completely unknown
_FREE_RAD = 1.0


class Visibility:
    """The part of displacements of n fixes that calibration does not absorb.

    Args:
        truth: the machine; its hidden effects are ignored.
        prism: (n,) names of the prisms.
        joints: joint name -> (n,) value, deg or mm.
        covariance_mm2: (n, 3, 3) covariance of the noise of each fix in the station's frame.
    """

    def __init__(self, truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], covariance_mm2: Floats) -> None:
        self._inverse_root = np.linalg.inv(np.linalg.cholesky(covariance_mm2))
        U, S, _ = np.linalg.svd(self._per_fix(_derivatives(truth, prism, joints)), full_matrices=False)
        self._taken = U, 1.0 - 1.0 / np.sqrt(1.0 + S**2)

    def seen(self, displacement_mm: Floats) -> Floats:
        """Return the (3 n, k) visible part of (n, 3, k) displacements, in units of the noise."""
        U, taken = self._taken
        own = self._per_fix(displacement_mm)
        left: Floats = own - U @ (taken[:, None] * (U.T @ own))
        return left

    def size(self, displacement_mm: Floats) -> float:
        """Return the visible size of one (n, 3) displacement: RMS in units of the noise."""
        return float(np.sqrt(np.mean(self.seen(displacement_mm[:, :, None]) ** 2)))

    def _per_fix(self, columns: Floats) -> Floats:
        return np.asarray(self._inverse_root @ columns).reshape(-1, columns.shape[2])


def reading_covariance_mm2(
    truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], sigma: Mapping[str, Floats]
) -> Floats:
    """Return the (n, 3, 3) covariance of the fixes due to independent errors of the joints' readings.

    Args:
        truth: the machine; its hidden effects are ignored.
        prism: (n,) names of the prisms.
        joints: joint name -> (n,) deg or mm.
        sigma: joint name -> (n,) standard deviation of its reading, deg or mm.
    """
    moved = [_moved_by(truth, prism, joints, {name: spread}) for name, spread in sigma.items()]
    J = np.stack(moved, axis=2)
    return np.asarray(J @ J.transpose(0, 2, 1))


def timing_covariance_mm2(
    truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], late: Mapping[str, Floats]
) -> Floats:
    """Return the (n, 3, 3) covariance of the fixes due to a timing error that is the same for all joints.

    Args:
        truth: the machine; its hidden effects are ignored.
        prism: (n,) names of the prisms.
        joints: joint name -> (n,) deg or mm.
        late: joint name -> (n,) change of its value in one standard deviation of the timing error, deg or mm.
    """
    J = _moved_by(truth, prism, joints, late)
    return J[:, :, None] * J[:, None, :]


def _moved_by(truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], steps: Mapping[str, Floats]) -> Floats:
    """Return the (n, 3) displacement of fixes by these steps of the joints, to first order."""
    there = {**joints, **{name: joints[name] + step * _STEP for name, step in steps.items()}}
    return (_places_mm(truth, prism, there) - _places_mm(truth, prism, joints)) / _STEP


def _derivatives(truth: RigTruth, prism: Strings, joints: Mapping[str, Floats]) -> Floats:
    """Return the (n, 3, p) displacement in mm by one tolerance of each constant that calibration may correct."""
    rig = truth.rig
    at = _places_mm(truth, prism, joints)
    angle, beta = np.deg2rad([rig.tolerances.angle_deg, rig.tolerances.beta_deg])
    length = rig.tolerances.length_mm
    tolerance = {"alpha": angle, "theta": angle, "beta": beta, "a": length, "d": length, "b": length}
    columns = []
    for number, row in enumerate(rig.rows):
        for constant in row.identify:
            moved = list(truth.constants)
            step = {constant: getattr(moved[number], constant) + tolerance[constant] * _STEP}
            moved[number] = replace(moved[number], **step)
            columns.append((_places_mm(truth, prism, joints, constants=moved) - at) / _STEP)
    for target in rig.prisms:
        if target.name in prism:
            spread = rig.tolerances.prism_mm if target.offset_known else _FREE_MM
            columns += [_places_mm(truth, prism, joints, moved=(target.name, axis * spread)) - at for axis in np.eye(3)]
    for axis in np.eye(3):  # the pose of the base is free
        columns.append(np.broadcast_to(axis * _FREE_MM, at.shape))
        columns.append(np.cross(axis, at - truth.placement().position_mm) * _FREE_RAD)
    return np.stack(columns, axis=2)


def _places_mm(
    truth: RigTruth,
    prism: Strings,
    joints: Mapping[str, Floats],
    *,
    constants: Sequence[RowConstants] | None = None,
    moved: tuple[str, Floats] = ("", np.zeros(3)),
) -> Floats:
    """Return the (n, 3) fixes of a machine without effects, in mm in the station's frame.

    Args:
        truth: the machine.
        prism: (n,) names of the prisms.
        joints: joint name -> (n,) deg or mm.
        constants: constants of all rows, replacing the machine's own.
        moved: name of a prism, and (3,) mm by which it is displaced in its frame.
    """
    rig = truth.rig
    chain = screw_chain(rig, truth.constants if constants is None else constants)
    read = {j.name: np.deg2rad(joints[j.name]) if j.kind == "revolute" else joints[j.name] for j in rig.joints}
    posture = pose_chain(chain, read)
    out = np.empty((len(prism), 3))
    for target in rig.prisms:
        rows = prism == target.name
        if rows.any():
            place = truth.prism_offset_mm(target.name) + (moved[1] if target.name == moved[0] else 0.0)
            out[rows] = posture.point_mm(target.frame, place)[rows]
    return truth.placement().to_station_mm(out)
