"""Random errors of readings, estimated from the prisms of the same standstill, which share these errors.

If the rig file is too optimistic about the encoders, or if readings are taken before the machine stands still, errors
differ from pose to pose and are correlated between all prisms of a pose. If they were treated as noise of the fixes,
they would count as evidence once for every prism.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from calibration.gap.background.system import Model, System
from calibration.gap.joint_fit import Problem
from calibration.observations import Floats

_LEAST_PAIRS = 60
_LARGER = 1.5  # ratio to the rig file's variance from which on the variance is increased


def with_reading_noise(problem: Problem, system: System, model: Model) -> Problem:
    """Return the problem with increased reading noise, where errors shared within standstills exceed the rig file's.

    Args:
        problem: the data.
        system: a linear model of the data.
        model: the effects and background found.
    """
    rig, solution = problem.solution.chain.rig, problem.solution
    shared = _shared_variance(system, model)
    known = solution.samples.shared_variance(rig)
    if not (shared > (_LARGER - 1.0) * known).any():
        return problem
    joints = [
        joint.model_copy(update={"sigma": math.hypot(joint.sigma, math.sqrt(more))})
        for joint, more in zip(rig.joints, shared.tolist(), strict=True)
    ]
    chain = solution.chain.of(rig.model_copy(update={"joints": tuple(joints)}))
    return replace(problem, solution=replace(solution, chain=chain))


def _shared_variance(system: System, model: Model) -> Floats:
    """Return the variances (joints,) of reading errors that samples of one standstill share, deg^2 or mm^2.

    The expected product of the errors of two samples is the sum over joints of the variance times the displacements of
    both samples. The variances are found by nonnegative least squares.
    """
    projection = system.projection
    samples = projection.samples
    pairs = [
        pair
        for own in np.split(np.argsort(samples.standstill, kind="stable"), _ends(samples.standstill))
        for pair in itertools.combinations(own[projection.fit.weight[own] > 0.5].tolist(), 2)
    ]
    count = projection.joint_jacobian.shape[2]
    if len(pairs) < _LEAST_PAIRS:
        return np.zeros(count)
    first, second = np.array(pairs).T
    left = system.residual(model).reshape(-1, 3)
    moved = projection.whitened(projection.joint_jacobian).reshape(len(left), 3, count)
    of_first = np.einsum("pcj,pck->pjk", moved[first], moved[first])
    of_second = np.einsum("pcj,pck->pjk", moved[second], moved[second])
    along = np.einsum("pcj,pc->pj", moved[first], left[first]) * np.einsum("pcj,pc->pj", moved[second], left[second])
    unit = np.sqrt(np.einsum("pjj,pjj->j", of_first, of_second))
    is_shared = unit > 0.0  # a joint that moves only one of two arms appears in no product
    unit = unit[is_shared]
    matrix = np.einsum("pjk,pjk->jk", of_first, of_second)[np.ix_(is_shared, is_shared)] / (unit * unit[:, None])
    variance = np.zeros(count)
    variance[is_shared] = nnls(matrix, along.sum(axis=0)[is_shared] / unit)[0] / unit
    return variance


def _ends(labels: np.ndarray) -> np.ndarray:
    """Return the indices at which the sorted labels (m,) change."""
    return np.flatnonzero(np.diff(np.sort(labels))) + 1
