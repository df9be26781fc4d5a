"""Remaining error of kinematics and effects, expressed as an error of every joint and estimated from training data.

An error of the joints grows with the lever arm of each prism, whereas the noise of fixes does not. So the data show how
much of their scatter is due to the model and how much to the instrument.
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

_SURE = 5.0  # gain in log likelihood; a smaller one may be chance
_LINEARITY_DEG = 0.1  # of an encoder without linearity in the rig file
_LINEARITY = 1e-3  # of a transducer's stroke
_FLOOR = 0.1  # least variance of a fitted row, relative to its known variance


def joint_error_sizes(rig: Rig) -> Floats:
    """Return the (joints,) systematic error of each joint, deg or mm: `linearity` of the rig file or a usual value."""
    return np.array(
        [
            (joint.linearity or _LINEARITY_DEG)
            if joint.kind == "revolute"
            else (joint.linearity or _LINEARITY) * (joint.limits[1] - joint.limits[0])
            for joint in rig.joints
        ]
    )


def joint_error_scale(model: CalibratedModel, observations: Observations, *, structured: bool = False) -> float:
    """Estimate the remaining error of kinematics and effects as a factor on `joint_error_sizes` of every joint.

    The errors of the training fixes have the covariance Sigma_known + s^2 I + k^2 J_q D J_q' - J C J': station and
    readings, uniform noise, and an error of the joints with the lever arms J_q, minus the part that the fit absorbed.
    Repeats are averaged. Both s and k are maximum-likelihood estimates, with k = 0 unless another value gains 5 in log
    likelihood. For that comparison the prisms of a standstill are correlated, as a joint's error is the same for all of
    them. The value of k, however, is estimated with independent fixes, so that it remains valid if errors that are
    missing in the model move the prisms of a standstill differently than joints do. If all lever arms are nearly equal,
    the data cannot distinguish the two. Errors that are known to be systematic then count as an error of the joints.

    Args:
        model: fitted to these rows; outliers are left out.
        observations: the training rows.
        structured: True if the errors are known to be systematic and not noise.

    Returns:
        k >= 0; 0 if uniform noise explains the scatter.
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
    """g groups of samples with correlated errors, all of the same size; c is 3 times the samples of a group.

    Attributes:
        error: (g, c) measured minus modelled, mm.
        known: (g, c, c) covariance due to station and readings, mm^2.
        by_joint: (g, c, c) covariance due to errors of all joints by their `joint_error_sizes`, mm^2.
        taken: (g, c, c) covariance that the fit absorbed, mm^2.
    """

    error: Floats
    known: Floats
    by_joint: Floats
    taken: Floats

    @cached_property
    def least(self) -> Floats:
        """(g, 1) least variance of any combination of a group's coordinates."""
        least: Floats = _FLOOR * traces(self.known)[:, None] / self.error.shape[1]
        return least

    def cost(self, even: float, lever: float) -> float:
        """Return the negative log likelihood for s^2 and k^2."""
        covariance = self.known + even * np.eye(self.error.shape[1]) + lever * self.by_joint - self.taken
        value, vector = np.linalg.eigh(covariance)
        value = np.maximum(value, self.least)
        along = np.einsum("gji,gj->gi", vector, self.error)
        return 0.5 * float(np.log(value).sum() + (along**2 / value).sum())


def _groups(model: CalibratedModel, rows: Observations, samples: Samples, label: Integers) -> list[_Groups]:
    """Group the m samples by label (m,)."""
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
    """Return the maximum-likelihood factor on the joint errors, and its gain in log likelihood over zero."""
    known, by_joint = _mean_variance(groups, "known"), _mean_variance(groups, "by_joint")
    if by_joint == 0.0:
        return 0.0, 0.0

    def cost(logarithms: Floats) -> float:
        """Return the negative log likelihood for log s^2 and, if given, log k^2."""
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
