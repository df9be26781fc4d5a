"""Outlier weights and scatter, given effects and background."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit

from calibration.gap.background.blocks import Block
from calibration.gap.background.evidence import Scales
from calibration.gap.background.system import Effect, System
from calibration.gap.joint_fit import JointFit, Problem
from calibration.identification.refinement import Fit

_ROUNDS = 5
_CONVERGED = 0.1  # largest change of a weight at convergence
_WIDTH = 30.0  # relative width of the outlier distribution, as in refinement
_SHARE = (1e-3, 0.2)  # limits of the share of outliers
_LEAST_EXCESS = 1e-9  # mm^2
_LEAST = 1e-6  # smallest weight, so that an outlier can become an inlier again


def reweighted(
    problem: Problem,
    joint: JointFit,
    blocks: Sequence[Block],
    effects: Sequence[Effect],
    start: Scales | None,
) -> tuple[Fit, Scales]:
    """Return a fit of the kinematics with outlier weights and scatter updated, given effects and background.

    Args:
        problem: the data.
        joint: the kinematics alone, with initial weights.
        blocks: blocks of the background.
        effects: (candidate, variant, scale) of each effect.
        start: initial scales of the background; plausible ones by default.

    Returns:
        The fit, and the scales of the background.
    """
    fit = replace(joint.fit, weight=np.maximum(joint.fit.weight, _LEAST))
    candidates = [candidate for candidate, _, _ in effects]
    scales = start
    for _ in range(_ROUNDS):
        projection = problem.project(replace(joint, fit=fit))
        known = projection.samples.variance(joint.context.rig, projection.joint_jacobian)
        whitened_with = known + fit.excess_variance
        system = System(projection, blocks, candidates, known / whitened_with)
        model = system.fit(system.chosen(effects), scales)
        scales, noise = model.scales, model.scales.noise
        square = (system.residual(model).reshape(-1, 3) ** 2).sum(axis=1) / noise / fit.weight
        share = float(np.clip(1.0 - fit.weight.mean(), *_SHARE))
        odds = math.log((1.0 - share) / share) + 3.0 * math.log(_WIDTH)
        weight = np.maximum(expit(odds - 0.5 * square * (1.0 - _WIDTH**-2)), _LEAST)
        moved = float(np.abs(weight - fit.weight).max())
        excess = max(noise * whitened_with - known, _LEAST_EXCESS)
        fit = replace(fit, weight=weight, excess_variance=excess)
        scales = replace(scales, noise=1.0)
        if moved < _CONVERGED:
            break
    assert scales is not None
    return fit, scales
