"""The steps in which encoders truly read: often coarser than their rig file says, as the readings themselves show.

Noise of one size along all axes is a poor stand-in for that of a coarse encoder, which is large across its lever arm
and nothing along it: effects that are plain beside the one drown in the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.base import Situation
from calibration.identification.refinement import Prior, refine
from calibration.identification.samples import covariance_by_joints
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations
from calibration.rig import Rig

_STEP_OFF = 0.02  # of a step, by which readings in steps may be off whole ones
_IN_STEPS = 0.98  # of the readings
_LEAST_VALUES = 8
_COARSER = 1.5  # times the rig file's step
_PART = 0.4  # of what a model leaves, and what a model leaves of it


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


@dataclass(frozen=True)
class Rounding:
    """Readings in coarser steps than the rig file has.

    Attributes:
        columns: step and the rig file's -> the columns that come so.
        moves_mm: RMS 3-D error that it makes of the positions.
    """

    columns: Mapping[tuple[float, float], tuple[str, ...]]
    moves_mm: float

    def doubts(self, left_mm: float) -> Iterator[str]:
        """A sentence where it makes a good part of the RMS 3-D error that a model leaves.

        Poses that were planned in whole steps and read in all digits leave far less than their steps would.
        """
        if _PART * left_mm < self.moves_mm < left_mm / _PART:
            steps = ", ".join(
                f"{' '.join(columns)} in steps of {step:.3g} (rig file: {resolution:g})"
                for (step, resolution), columns in self.columns.items()
            )
            yield (
                f"readings are rounded, which moves the prisms by {self.moves_mm:.2g} mm RMS: {steps}; record all "
                f"digits, or correct the resolution in the rig file"
            )


def rounding(situation: Situation) -> Rounding:
    """What steps of the readings do that are coarser than the rig file's."""
    rig = situation.rig
    steps = _coarser(rig, situation.observations)
    variance = np.array([steps.get(name, 0.0) ** 2 / 12.0 for name in rig.joint_names])
    covariance = covariance_by_joints(situation.located.joint_jacobian, variance)
    columns: dict[tuple[float, float], tuple[str, ...]] = {}
    for name, step in steps.items():
        alike = float(f"{step:.3g}"), rig.joint(name).resolution
        columns[alike] = (*columns.get(alike, ()), rig.joint(name).column)
    return Rounding(columns, math.sqrt(float(np.trace(covariance, axis1=1, axis2=2).mean())))


def _as_read(rig: Rig, observations: Observations) -> Rig:
    steps = _coarser(rig, observations)
    if not steps:
        return rig
    joints = [j.model_copy(update={"resolution": steps[j.name]}) if j.name in steps else j for j in rig.joints]
    return rig.model_copy(update={"joints": tuple(joints)})


def _coarser(rig: Rig, observations: Observations) -> dict[str, float]:
    """Joint -> the step of its readings, where that is coarser than the rig file's."""
    steps = {joint.name: step_of(observations.joints[joint.name]) for joint in rig.joints}
    return {joint.name: steps[joint.name] for joint in rig.joints if steps[joint.name] > _COARSER * joint.resolution}


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
