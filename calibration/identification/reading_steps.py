"""Resolution of the encoders as the readings themselves show it: often coarser than the rig file says.

Noise of one size along all axes is a poor stand-in for that of a coarse encoder, which is large across its lever arm
and nothing along it: effects that are plain beside the one drown in the other.
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

_STEP_OFF = 0.02  # of a step, by which readings in steps may be off whole ones
_IN_STEPS = 0.98  # of the readings
_LEAST_VALUES = 8
_COARSER = 1.5  # times the rig file's step
_PART = 0.4  # of what a model leaves, and what a model leaves of it


def in_true_steps(solution: Solution, observations: Observations, prior: Prior) -> Solution:
    """Refit a solution with the noise of readings in the steps that they come in, if the rig file has finer ones.

    Args:
        solution: of the kinematics alone, fitted to `observations`.
        observations: the rows.
        prior: that it was found with.
    """
    rig = solution.chain.rig
    steps = _coarser(rig, observations)
    if not steps:
        return solution
    joints = [j.model_copy(update={"resolution": steps[j.name]}) if j.name in steps else j for j in rig.joints]
    chain = solution.chain.of(rig.model_copy(update={"joints": tuple(joints)}))
    return replace(solution, chain=chain, fit=refine(chain, solution.samples, solution.fit.x, prior=prior))


def rounding(context: EffectContext, left_mm: float) -> tuple[float, str | None]:
    """Find readings that are rounded, where that makes a good part of the errors that a model leaves.

    Poses that were planned in whole steps and read in all digits leave far less than their steps would.

    Args:
        context: the rows.
        left_mm: RMS 3-D error that the model leaves.

    Returns:
        RMS 3-D error by the rounding, mm, and a sentence; 0 and None where it makes no good part.
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
    """Step of the readings by joint, where it is coarser than the rig file's."""
    steps = {joint.name: step_of(observations.joints[joint.name]) for joint in rig.joints}
    return {joint.name: steps[joint.name] for joint in rig.joints if steps[joint.name] > _COARSER * joint.resolution}


def step_of(readings: Floats) -> float:
    """Step in which a joint's readings (n,) come; 0 where none is seen."""
    values = np.unique(readings)
    if len(values) < _LEAST_VALUES:
        return 0.0
    between = np.diff(values)
    step = float(between[between > _STEP_OFF * np.median(between)].min())
    whole = (readings - values[0]) / step
    off = np.abs(whole - np.rint(whole))
    return step if float((off < _STEP_OFF).mean()) >= _IN_STEPS else 0.0
