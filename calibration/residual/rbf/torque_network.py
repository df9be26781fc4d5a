"""The second paper's network on joint torques for the errors of calibrated kinematics (RBF-TCM).

ICIC 2020, Eqs. 9-14: the inputs are the gravity torques of all joints, and a unit is exp(-(|w - p| b)^2) about the
torques of a training row. Up to 40 units are added one at a time where the error is largest, and the linear output
(with a constant) is solved again each time. The paper specifies neither the width of a unit nor when to stop. Here
1 / b is a multiple of the median distance between the training rows' torques; the multiple and the number of units are
those with the least squared error in leave-one-out over groups of the training rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.stored_arrays import read_npz, write_npz
from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.residual.folds import folds

_MOST_UNITS = 40
_TRIES = 4  # candidates for each unit, as rows whose torques repeat those of a unit are skipped
_MOST_FOLDS = 50
_MOST_DISTANCES = 1000
_WIDTHS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # 1 / b, in median distances between training rows
_NEW = 1e-6  # least share of a unit's activation that is independent of the units before it
_FILE = "torque_network.npz"


@dataclass(frozen=True)
class TorqueNetwork:
    """A fitted network.

    Attributes:
        names: names of its feature columns, `torque_<joint>_Nm`.
        units: (m, t) torques at the centres of the units, N m.
        inverse_width: b, 1 / (N m).
        output: (1 + m, 3) constant and weights of the units, mm.
    """

    kind: ClassVar[str] = "rbf-tcm"

    names: tuple[str, ...]
    units: Floats
    inverse_width: float
    output: Floats

    def predict(self, features: Features) -> Floats:
        """Return the (n, 3) estimate of the residual in the base frame, mm."""
        estimate: Floats = _design(features.columns(self.names), self.units, self.inverse_width) @ self.output
        return estimate

    def fits(self, features: Features) -> bool:
        """Return True if its torques are among these columns."""
        return set(self.names) <= set(features.names)

    def to_files(self) -> dict[str, bytes]:
        """Return one npz file without pickled objects."""
        parts = {"units": self.units, "inverse_width": np.array([self.inverse_width]), "output": self.output}
        return {_FILE: write_npz({"names": np.array(self.names, dtype=np.str_), **parts})}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> TorqueNetwork:
        """Restore from `to_files`; KeyError or ValueError if parts are missing or do not match."""
        stored = read_npz(files[_FILE])
        names = tuple(stored["names"].astype(str).tolist())
        units, width, output = (np.asarray(stored[k], dtype=np.float64) for k in ("units", "inverse_width", "output"))
        if units.shape[1:] != (len(names),) or output.shape != (len(units) + 1, 3) or width.shape != (1,):
            raise ValueError("the shapes of the network's arrays do not match")
        return cls(names, units, float(width[0]), output)


def fit_torque_network(
    features: Features, target_mm: Floats, groups: NDArray[np.str_], names: Sequence[str], *, seed: int
) -> tuple[TorqueNetwork, Floats]:
    """Choose width and number of units by leave-one-out, then fit to all rows.

    Args:
        features: n rows.
        target_mm: (n, 3) residuals in the base frame.
        groups: (n,) labels of rows that are left out together, at least two. More than 50 are combined into 50 folds.
        names: columns of the torques.
        seed: seed of the folds.

    Returns:
        The network, and (n, 3) out-of-fold estimates by networks of the same width and number of units, mm.
    """
    torques = features.columns(names)
    split = folds(groups, _MOST_FOLDS, seed)
    some = torques[:: len(torques) // _MOST_DISTANCES + 1]
    reach = max(float(np.median(_distance(some, some)[np.triu_indices(len(some), 1)])), 1e-9)
    inverse_widths = [1.0 / (width * reach) for width in _WIDTHS]
    estimates = {b: _left_out(torques, target_mm, split, b) for b in inverse_widths}
    errors = {b: ((target_mm - estimate) ** 2).sum(axis=(1, 2)) for b, estimate in estimates.items()}
    inverse_width = min(errors, key=lambda b: float(errors[b].min()))
    count = int(errors[inverse_width].argmin()) + 1
    rows, triangle, moments = _grow(torques, target_mm, inverse_width, count)
    output = np.asarray(np.linalg.solve(triangle, moments), dtype=np.float64)
    network = TorqueNetwork(tuple(names), torques[rows], inverse_width, output)
    return network, estimates[inverse_width][count - 1]


def _left_out(torques: Floats, target_mm: Floats, split: NDArray[np.intp], inverse_width: float) -> Floats:
    """Return (units, n, 3) estimates of every row by networks of 1, 2, ... units trained without its fold."""
    out = np.empty((_MOST_UNITS, *target_mm.shape))
    for fold in np.unique(split):
        held = split == fold
        inside = torques[~held]
        rows, triangle, moments = _grow(inside, target_mm[~held], inverse_width, _MOST_UNITS)
        unseen = _design(torques[held], inside[rows], inverse_width)
        # Leading blocks of the triangle belong to the smaller networks.
        parts = np.cumsum(np.linalg.solve(triangle.T, unseen.T).T[:, :, None] * moments, axis=1)
        last = len(rows)
        out[:last, held] = parts[:, 1:].transpose(1, 0, 2)
        out[last:, held] = parts[:, -1]
    return out


def _grow(
    torques: Floats, target_mm: Floats, inverse_width: float, most: int
) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Add units where the error is largest, and solve the output again each time by orthogonalisation.

    Returns:
        Rows at the centres of the units; the triangle R (1 + m, 1 + m) of constant and activations; and Q' target
        (1 + m, 3). The leading parts of both belong to the networks with fewer units.
    """
    n = len(torques)
    most = max(min(most, n - 2), 0)
    basis = np.zeros((most + 1, n))
    triangle, moments = np.eye(most + 1), np.zeros((most + 1, 3))
    basis[0], triangle[0, 0] = 1.0 / np.sqrt(n), np.sqrt(n)
    moments[0] = basis[0] @ target_mm
    left = target_mm - basis[0][:, None] * moments[0]
    is_open = np.ones(n, dtype=bool)
    rows: list[int] = []
    for _ in range(min(_TRIES * most, n)):
        if len(rows) == most:
            break
        row = int(np.argmax(np.where(is_open, (left**2).sum(axis=1), -1.0)))
        is_open[row] = False
        column = _activation(torques, torques[[row]], inverse_width)[:, 0]
        before = basis[: len(rows) + 1]
        along = before @ column
        across = column - along @ before
        again = before @ across  # repeating it once makes the columns orthogonal to rounding
        across -= again @ before
        size = float(np.linalg.norm(across))
        if size < _NEW * float(np.linalg.norm(column)):
            continue
        rows.append(row)
        new = len(rows)
        basis[new], triangle[:new, new], triangle[new, new] = across / size, along + again, size
        moments[new] = basis[new] @ target_mm
        left -= basis[new][:, None] * moments[new]
    used = len(rows) + 1
    return np.array(rows, dtype=np.intp), triangle[:used, :used], moments[:used]


def _design(torques: Floats, units: Floats, inverse_width: float) -> Floats:
    """Return (n, 1 + m) constant and activations."""
    return np.column_stack([np.ones(len(torques)), _activation(torques, units, inverse_width)])


def _activation(torques: Floats, units: Floats, inverse_width: float) -> Floats:
    activation: Floats = np.exp(-((_distance(torques, units) * inverse_width) ** 2))
    return activation


def _distance(a: Floats, b: Floats) -> Floats:
    square: Floats = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    distance: Floats = np.sqrt(np.maximum(square, 0.0))
    return distance
