"""Outliers, scatter and reading errors are judged beside effects and background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.gap.background.blocks import smooth_blocks
from calibration.gap.background.reading_noise import with_reading_noise
from calibration.gap.background.search import search_given_background
from calibration.gap.background.weights import reweighted
from calibration.gap.joint_fit import Problem
from calibration.identification.samples import averaged
from calibration.identification.solve import solve
from calibration.observations import Observations, parse_observations
from calibration.run_settings import DEFAULT_RUN
from daemon.rig_files import load_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
RIG = SOURCE.rig


def problem(rows: Observations) -> Problem:
    return Problem(solve(RIG, rows, prior="recalibration", run=DEFAULT_RUN), rows, "recalibration", 0)


def simulated(seed: int, poses: int) -> Observations:
    """Return fixes of all prisms in every pose, whose poses have no names."""
    data = simulate_observations(RigTruth(RIG, seed), poses, seed, noise_mm=1.0)
    rows = parse_observations(data.csv_text().encode(), RIG, "machine.csv")
    return replace(rows, pose=np.full_like(rows.pose, ""))


def test_fixes_with_the_very_same_readings_are_of_one_standstill() -> None:
    rows = simulated(1, 20)
    own = problem(rows).solution
    standstill = averaged(own.chain, rows).standstill
    assert len(np.unique(standstill)) == 20
    assert (np.bincount(np.unique(standstill, return_inverse=True)[1]) == len(RIG.prisms)).all()


def test_a_gross_outlier_is_weighted_out_and_the_others_are_not() -> None:
    rows = simulated(2, 40)
    position = rows.position_mm.copy()
    position[7] += 60.0
    own = problem(replace(rows, position_mm=position))
    joint = own.with_mild_outliers(own.kinematics_only())
    fit, scales = reweighted(own, joint, smooth_blocks(joint.context, own.solution.samples.average), (), None)
    assert fit.weight[own.solution.samples.of_row[7]] < 0.01
    assert (fit.weight < 0.5).sum() == 1
    assert set(scales.blocks)


def test_reading_errors_that_prisms_share_are_found_at_their_joint() -> None:
    """The third joint's readings err by 0.2 deg, anew in each pose; the rig file has far better encoders."""
    rows = simulated(3, 60)
    error = np.repeat(np.random.default_rng(4).normal(0.0, 0.2, 60), len(RIG.prisms))
    joints = {**rows.joints, "theta3": rows.joints["theta3"] + error}
    own = problem(replace(rows, joints=joints))
    joint = own.with_mild_outliers(own.kinematics_only())
    system, model = search_given_background(own, joint, (), ("angle_scale",), ())
    sigma = {j.name: j.sigma for j in with_reading_noise(own, system, model).solution.chain.rig.joints}
    assert sigma["theta3"] == pytest.approx(0.2, rel=0.4)
    assert all(sigma[j.name] < 0.1 for j in RIG.joints if j.kind == "revolute" and j.name != "theta3")
