"""Error that kinematics and effects leave, as the size of an error of every joint, from the training data.

An error that enters through the joints grows with the lever arm of each prism, which noise of the fixes does not; so
the data say how much of their scatter is the model's and how much the instrument's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from calibration.identification.noise import covariance_by_joints
from calibration.identification.samples import Samples, averaged
from calibration.kinematics.chain import Integers
from calibration.model.model import CalibratedModel
from calibration.model.prediction import OUTLIER_SIGMA, Predictor
from calibration.numerics.matrices import traces
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

_SURE = 5.0  # in log likelihood; less is chance
_LINEARITY_DEG = 0.1  # of an encoder whose rig file gives none
_LINEARITY = 1e-3  # of a transducer's stroke
_FLOOR = 0.1  # of the known variance: what a fitted row keeps at least


def joint_error_sizes(rig: Rig) -> Floats:
    """(joints,) systematic error of each joint that its rig file names (`linearity`), or a usual one, deg or mm."""
    return np.array(
        [
            (joint.linearity or _LINEARITY_DEG)
            if joint.kind == "revolute"
            else (joint.linearity or _LINEARITY) * (joint.limits[1] - joint.limits[0])
            for joint in rig.joints
        ]
    )


def joint_error_scale(model: CalibratedModel, observations: Observations, *, structured: bool = False) -> float:
    """Estimate the error that kinematics and effects leave, as one of every joint, in units of `joint_error_sizes`.

    The errors of the training fixes have the covariance Sigma_known + s^2 I + k^2 J_q D J_q' - J C J': station and
    readings, even noise, an error of the joints with the lever arms J_q, less what the fit took. Repeats are averaged.
    Maximum likelihood in s and k, with k = 0 unless the data prefer another by 5 in log likelihood. For that the prisms
    of a standstill count together, as a joint's error is the same at each; but the size of k is that of the fixes each
    by itself, which holds also where what the model lacks moves the prisms of a standstill otherwise than joints do.
    Where the lever arms are much the same everywhere, the data cannot prefer; what is known to have structure counts as
    an error of the joints all the same.

    Args:
        model: fitted to these rows; outliers are left out.
        observations: the training rows.
        structured: True if the errors are known to depend on something, and so are no noise.

    Returns:
        k >= 0; 0 where even noise explains the scatter.
    """
    rows = observations.select(Predictor.of(model).deviations(observations) <= OUTLIER_SIGMA)
    if len(rows) == 0:
        return 0.0
    samples = averaged(model.chain, rows)
    each = _groups(model, rows, samples, np.arange(len(samples)))
    scale, gain = _likeliest(each, model.excess_sigma_mm)
    if gain > _SURE:
        _, gain = _likeliest(_groups(model, rows, samples, samples.standstill), model.excess_sigma_mm)
    if gain > _SURE:
        return scale
    by_joint = _mean_variance(each, "by_joint")
    return model.excess_sigma_mm / math.sqrt(by_joint) if structured and by_joint > 0.0 else 0.0


@dataclass(frozen=True)
class _Groups:
    """Groups of equally many samples that err together, g of them with c = 3 coordinates a sample.

    Attributes:
        error: (g, c) measured minus modelled.
        known: (g, c, c) covariance by station and readings.
        by_joint: (g, c, c) covariance by an error of every joint in `joint_error_sizes`.
        taken: (g, c, c) what the fit took.
    """

    error: Floats
    known: Floats
    by_joint: Floats
    taken: Floats

    @cached_property
    def least(self) -> Floats:
        """(g, 1) variance that any combination of a group's coordinates keeps."""
        least: Floats = _FLOOR * traces(self.known)[:, None] / self.error.shape[1]
        return least

    def cost(self, even: float, lever: float) -> float:
        """Negative log likelihood for s^2 and k^2."""
        covariance = self.known + even * np.eye(self.error.shape[1]) + lever * self.by_joint - self.taken
        value, vector = np.linalg.eigh(covariance)
        value = np.maximum(value, self.least)
        along = np.einsum("gji,gj->gi", vector, self.error)
        return 0.5 * float(np.log(value).sum() + (along**2 / value).sum())


def _groups(model: CalibratedModel, rows: Observations, samples: Samples, label: Integers) -> list[_Groups]:
    """The samples in groups of one label (m,)."""
    rig = model.rig
    lin = Predictor.of(model).linearise(rows)
    error = samples.average(rows.position_mm - lin.position_mm)
    by_reading, by_parameter = samples.average(lin.joint_jacobian), samples.average(lin.jacobian)
    taken = (by_parameter.reshape(-1, len(model.covariance)) @ model.covariance).reshape(by_parameter.shape)
    unsure = samples.shared_variance(rig) + samples.average(Predictor.of(model).unknown_variance(rows))
    alone = samples.own_covariance(rig, by_reading)
    order = np.argsort(label, kind="stable")
    start, count = np.unique(label[order], return_index=True, return_counts=True)[1:]
    found = []
    for size in np.unique(count).tolist():
        at = order[start[count == size][:, None] + np.arange(size)]  # (g, size) samples
        shape = len(at), 3 * size
        known = np.zeros((len(at), size, 3, size, 3))
        for i in range(size):
            known[:, i, :, i] = alone[at[:, i]]
        arms, fitted = by_reading[at].reshape(*shape, -1), by_parameter[at].reshape(*shape, -1)
        found.append(
            _Groups(
                error[at].reshape(shape),
                known.reshape(*shape, 3 * size) + covariance_by_joints(arms, unsure[at].mean(axis=1)),
                covariance_by_joints(arms, joint_error_sizes(rig) ** 2),
                taken[at].reshape(*shape, -1) @ fitted.transpose(0, 2, 1),
            )
        )
    return found


def _likeliest(groups: list[_Groups], excess_sigma_mm: float) -> tuple[float, float]:
    """The likeliest size of an error of every joint, and what it gains in log likelihood over none."""
    known, by_joint = _mean_variance(groups, "known"), _mean_variance(groups, "by_joint")
    if by_joint == 0.0:
        return 0.0, 0.0

    def cost(logarithms: Floats) -> float:
        """Negative log likelihood for log s^2 and, where given, log k^2."""
        even, lever = [*np.exp(logarithms), 0.0][:2]
        return sum(g.cost(even, lever) for g in groups)

    def best(*start: float) -> tuple[Floats, float]:
        found = minimize(cost, np.array(start), method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01})
        return found.x, float(found.fun)

    even = math.log(max(excess_sigma_mm**2, 0.01 * _FLOOR * known))
    _, without = best(even)
    at, with_joints = best(even, even - math.log(by_joint))
    return math.exp(0.5 * float(at[1])), without - with_joints


def _mean_variance(groups: list[_Groups], part: Literal["known", "by_joint"]) -> float:
    """Return the mean variance of one coordinate of a fix, mm^2."""
    return sum(float(traces(getattr(g, part)).sum()) for g in groups) / sum(g.error.size for g in groups)
