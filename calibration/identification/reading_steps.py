"""Resolution of the encoders as seen in the readings, which is often coarser than in the rig file.

Noise of equal size along all axes is a poor approximation for the noise of a coarse encoder, which is large across the
lever arm and zero along it. An effect that is plain with the right noise model drowns in the approximation.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calibration.effects.context import EffectContext
from calibration.identification.noise import covariance_by_joints
from calibration.identification.refinement import Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations
from calibration.rig.description import Rig

_STEP_OFF = 0.02  # of a step: greatest distance of a reading from a whole number of steps
_IN_STEPS = 0.98  # least share of the readings at whole steps
_LEAST_VALUES = 8
_COARSER = 1.5  # times the rig file's step
_PART = 0.4  # least ratio between rounding errors and a model's errors, either way


def in_true_steps(solution: Solution, observations: Observations, prior: Prior) -> Solution:
    """Refit a solution with the resolution that the readings show, if it is coarser than the rig file's.

    Args:
        solution: of the kinematics alone, fitted to `observations`.
        observations: the rows.
        prior: the prior with which `solution` was found.
    """
    rig = solution.chain.rig
    steps = _coarser(rig, observations)
    if not steps:
        return solution
    joints = [j.model_copy(update={"resolution": steps[j.name]}) if j.name in steps else j for j in rig.joints]
    chain = solution.chain.of(rig.model_copy(update={"joints": tuple(joints)}))
    return replace(solution, chain=chain, fit=refine(chain, solution.samples, solution.fit.x, prior=prior))


def rounding(context: EffectContext, left_mm: float) -> tuple[float, str | None]:
    """Find rounded readings, if the rounding explains a large part of a model's errors.

    Poses that were planned in whole steps but read with all digits leave much smaller errors than rounding would.

    Args:
        context: the rows.
        left_mm: RMS 3-D error of the model.

    Returns:
        RMS 3-D error due to the rounding, mm, and a sentence; 0 and None if that is not a large part.
    """
    rig = context.rig
    steps = _coarser(rig, context.observations)
    variance = np.array([steps.get(name, 0.0) ** 2 / 12.0 for name in rig.joint_names])
    covariance = covariance_by_joints(context.located.joint_jacobian, variance)
    moves_mm = math.sqrt(float(np.trace(covariance, axis1=1, axis2=2).mean()))
    if not _PART * left_mm < moves_mm < left_mm / _PART:
        return 0.0, None
    columns: dict[str, list[str]] = {}
    for name, step in steps.items():
        joint = rig.joint(name)
        columns.setdefault(f"in steps of {step:.3g} (rig file: {joint.resolution:g})", []).append(joint.column)
    rounded = ", ".join(f"{' '.join(names)} {alike}" for alike, names in columns.items())
    return moves_mm, (
        f"readings are rounded, which moves the prisms by {moves_mm:.2g} mm RMS: {rounded}; record all "
        f"digits, or correct the resolution in the rig file"
    )


def _coarser(rig: Rig, observations: Observations) -> dict[str, float]:
    """Return the step of the readings of each joint where it is coarser than the rig file's."""
    steps = {joint.name: step_of(observations.joints[joint.name]) for joint in rig.joints}
    return {joint.name: steps[joint.name] for joint in rig.joints if steps[joint.name] > _COARSER * joint.resolution}


def step_of(readings: Floats) -> float:
    """Return the step between a joint's readings (n,), deg or mm; 0 if they are not in steps."""
    values = np.unique(readings)
    if len(values) < _LEAST_VALUES:
        return 0.0
    between = np.diff(values)
    step = float(between[between > _STEP_OFF * np.median(between)].min())
    whole = (readings - values[0]) / step
    off = np.abs(whole - np.rint(whole))
    return step if float((off < _STEP_OFF).mean()) >= _IN_STEPS else 0.0
