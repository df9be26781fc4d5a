"""The steps in which encoders truly read: often coarser than their rig file says, as the readings themselves show.

Noise of one size along all axes is a poor stand-in for that of a coarse encoder, which is large across its lever arm
and nothing along it: effects that are plain beside the one drown in the other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.identification.refinement import Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations
from calibration.rig import Rig

_STEP_OFF = 0.02  # of a step, by which readings in steps may be off whole ones
_IN_STEPS = 0.98  # of the readings
_LEAST_VALUES = 8
_COARSER = 1.5  # times the rig file's step


def in_true_steps(solution: Solution, observations: Observations, prior: Prior) -> Solution:
    """A solution of the kinematics alone with the noise of readings in the steps that they come in; itself if the rig
    file has them.

    Args:
        solution: fitted to `observations`.
        observations: the rows.
        prior: as it was found with.
    """
    rig = _as_read(solution.chain.rig, observations)
    if rig is solution.chain.rig:
        return solution
    chain = solution.chain.of(rig)
    return replace(solution, chain=chain, fit=refine(chain, solution.samples, solution.fit.x, prior=prior))


def _as_read(rig: Rig, observations: Observations) -> Rig:
    steps = {joint.name: step_of(observations.joints[joint.name]) for joint in rig.joints}
    coarser = {joint.name for joint in rig.joints if steps[joint.name] > _COARSER * joint.resolution}
    if not coarser:
        return rig
    joints = [j.model_copy(update={"resolution": steps[j.name]}) if j.name in coarser else j for j in rig.joints]
    return rig.model_copy(update={"joints": tuple(joints)})


def step_of(readings: Floats) -> float:
    """The step in which a joint's readings (n,) come; 0 where they come in none that is seen."""
    values = np.unique(readings)
    if len(values) < _LEAST_VALUES:
        return 0.0
    between = np.diff(values)
    step = float(between[between > _STEP_OFF * np.median(between)].min())
    whole = (readings - values[0]) / step
    off = np.abs(whole - np.rint(whole))
    return step if float((off < _STEP_OFF).mean()) >= _IN_STEPS else 0.0
