"""Measured data: a UR10 under a laser tracker, split by 100 mm workspace cells."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.evaluation.evaluation import evaluate
from calibration.model.model import CalibratedModel
from calibration.observations import Observations
from calibration.pipeline.calibrate import identify, train_residual
from calibration.rig.description import shipped_rig
from tests.calibration.conftest import rig_text, split_by_cells

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def identified(ur10_random_poses: Observations) -> tuple[CalibratedModel, Observations, Observations]:
    training, held_out = split_by_cells(ur10_random_poses, 0.45, 0)
    return identify(shipped_rig("ur10"), rig_text("ur10"), training), training, held_out


def stages(model: CalibratedModel, held_out: Observations) -> dict[str, float]:
    return {str(s["stage"]): float(s["rms_mm"]) for s in evaluate(model, held_out).stages()}


def test_kinematics_reach_half_a_millimetre_on_held_out_cells(
    identified: tuple[CalibratedModel, Observations, Observations],
) -> None:
    model, _, held_out = identified
    found = stages(model, held_out)
    assert found["nominal"] == pytest.approx(1.0, abs=0.1)
    assert found["geometric"] <= 0.50


def test_the_curves_of_its_joints_are_named_and_close_four_fifths_of_that(
    identified: tuple[CalibratedModel, Observations, Observations],
) -> None:
    model, _, held_out = identified
    assert {e.family for e in model.effects} == {"joint_error_map"}
    assert {e.where for e in model.effects} >= {"q1", "q2", "q3"}
    found = stages(model, held_out)
    assert found["effects"] <= 0.11
    assert model.noise_mm == pytest.approx(found["effects"], rel=0.15)


def test_a_hundred_poses_are_enough_for_six_tenths(
    identified: tuple[CalibratedModel, Observations, Observations],
) -> None:
    _, training, held_out = identified
    few = training.select(np.linspace(0, len(training) - 1, 100).astype(int))
    model = identify(shipped_rig("ur10"), rig_text("ur10"), few)
    assert stages(model, held_out)["geometric"] <= 0.60


def test_the_residual_learns_what_the_effects_leave_and_knows_what_it_leaves(
    identified: tuple[CalibratedModel, Observations, Observations],
) -> None:
    model, training, held_out = identified
    learned = train_residual(model, training)
    assert learned.residual is not None
    found = stages(learned, held_out)
    assert found["hybrid"] <= 0.10
    assert found["hybrid"] < found["effects"]
    assert learned.noise_mm == pytest.approx(found["hybrid"], rel=0.15)
    evaluation = evaluate(learned, held_out)
    # A few cells decide: with 70 % of them for training, nine divisions gave 0.77 to 1.23 and 1.04 in the mean.
    assert 0.75 < float(((evaluation.errors_mm["hybrid"] / evaluation.sigma_mm) ** 2).mean()) < 1.25
