from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.design.accuracy import ExpectedAccuracy, expected_accuracy, predicted_accuracy
from calibration.design.knowledge import Knowledge
from calibration.design.planning import plan_poses
from calibration.identification.noise import covariance_by_joints
from calibration.model.joint_errors import joint_error_scale, joint_error_sizes
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text, rms, simulated, split_by_cells
from tests.simulated.observations import simulate_observations

BAND = (0.85, 1.18)  # expected over actual RMS, of several machines together


def actual_mm(model: CalibratedModel, truth: RigTruth, readings: Floats) -> Floats:
    """(n, prisms) distance of the model's positions from the true ones."""
    rig = model.rig
    lin = Knowledge.of_model(model, 0).linearise(readings)
    held = dict(zip(rig.joint_names, readings.T, strict=True))
    true_mm = np.stack([truth.prism_mm(name, held) for name in rig.prism_names], axis=1)
    return np.linalg.norm(lin.position_mm.reshape(true_mm.shape) - true_mm, axis=2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("hidden", "lacks"),
    [("", False), ("boom_droop@boom", True), ("encoder_harmonic@theta4:k=2:cosk_rad=2e-3:sink_rad=1e-3", True)],
)
def test_the_expected_error_over_the_work_volume_is_the_actual_one(hidden: str, lacks: bool) -> None:
    """Machines with 3 mm of noise on each coordinate, more than the rig file says: noise is not the model's error."""
    rig = shipped_rig("swdt82")
    expected, actual = [], []
    for seed in range(20, 23):
        truth = RigTruth(rig, seed, effects=parse_effects(hidden))
        training = simulated(truth, 200, seed)
        model = identify(rig, rig_text("swdt82"), training, effects="none")
        assert (model.joint_error_scale > 0.0) == lacks
        found = expected_accuracy(model, np.random.default_rng(seed), poses=300)
        expected.append(found.rms_3d_mm)
        actual.append(actual_mm(model, truth, found.readings))
    ratio = np.sqrt(np.mean(np.square(expected)) / np.mean(np.square(actual)))
    assert BAND[0] < ratio < BAND[1]


@pytest.mark.long
def test_on_measured_data_the_expected_error_is_the_held_out_one(ur10_random_poses: Observations) -> None:
    """Tracker noise is some 0.02 mm: what is left on held-out cells is the model's."""
    training, held_out = split_by_cells(ur10_random_poses, 0.15, 0)
    model = identify(shipped_rig("ur10"), rig_text("ur10"), training, effects="none")
    knowledge = Knowledge.of_model(model, 0)
    readings = np.column_stack([held_out.joints[name] for name in model.rig.joint_names])
    found = predicted_accuracy(knowledge, knowledge.root, readings, joint_error_scale=model.joint_error_scale)
    left_mm = rms(held_out.position_mm - Predictor.of(model).geometric_mm(held_out))
    assert found.rms_mm == pytest.approx(left_mm, rel=0.15)


@pytest.mark.long
def test_statistics_are_those_of_the_errors(session: Session) -> None:
    found = expected_accuracy(session.model, np.random.default_rng(1), poses=200)
    answer = found.as_dict()
    covariance = (found.parameters_mm2 + found.lacking_mm2 + found.open_mm2).reshape(-1, 3, 3)
    drawn = np.random.default_rng(9).standard_normal((200, len(covariance), 3, 1))
    error_mm = np.linalg.norm((np.linalg.cholesky(covariance) @ drawn)[..., 0], axis=-1)
    assert np.mean(error_mm < answer["p95_mm"]) == pytest.approx(0.95, abs=0.003)
    assert np.mean(error_mm < answer["p99_mm"]) == pytest.approx(0.99, abs=0.002)
    assert answer["mean_mm"] == pytest.approx(error_mm.mean(), rel=0.01)
    assert answer["median_mm"] == pytest.approx(np.median(error_mm), rel=0.01)
    assert answer["worst"]["rms_3d_mm"] == found.rms_3d_mm.max()
    assert list(answer["worst"]["joints"]) == [j.column for j in session.rig.joints]
    assert list(answer["per_prism"]) == list(session.rig.prism_names)
    squares = [s["rms_mm"] ** 2 for s in answer["per_prism"].values()]
    assert answer["rms_mm"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert answer["median_mm"] < answer["mean_mm"] < answer["rms_mm"] < answer["p95_mm"] < answer["p99_mm"]
    parts = [answer["parameters_mm"], answer["lacking_mm"], answer["open_mm"]]
    assert answer["rms_mm"] == pytest.approx(np.linalg.norm(parts))


@pytest.mark.long
def test_the_worst_part_of_a_range_is_named(session: Session) -> None:
    readings = np.random.default_rng(0).uniform(0.0, 1.0, (300, 9))
    for index, joint in enumerate(session.rig.joints):
        readings[:, index] = joint.limits[0] + (joint.limits[1] - joint.limits[0]) * readings[:, index]
    variance = np.ones((300, 4))
    variance[readings[:, 7] > 1446.0] = 9.0
    variance[:, 2] *= 4.0
    covariance = variance[:, :, None, None] * np.eye(3)
    found = ExpectedAccuracy(session.rig, "", readings, covariance, *np.zeros((2, *covariance.shape)))
    assert "prism r" in found.where
    assert "where L2 is 1445 .. 2168 mm" in found.where


@pytest.mark.long
def test_after_a_session_the_next_poses_go_where_the_model_is_poor() -> None:
    rig = shipped_rig("swdt82")
    truth = RigTruth(rig, 3)
    training = simulated(truth, 80, 3)
    training = training.select((training.joints["theta5"] < 5.0) & (training.prism != "b"))
    model = identify(rig, rig_text("swdt82"), training)
    planned = plan_poses(rig, 10, model=model)
    assert planned.before is not None
    assert planned.after.rms_mm < 0.7 * planned.before.rms_mm
    advice = "\n".join(planned.advice)
    assert "10 poses would lower the expected error over the work volume from" in advice
    assert "theta5 was measured only at -2" in advice
    assert "prism b has no fixes yet" in advice
    beyond = [row for row in planned.rows if row.joints["theta5_deg"] > 5.0]
    assert len(beyond) >= 3
    assert sum("b" in row.prisms for row in planned.rows) >= 5
    assert not planned.warnings


def test_repeats_of_a_standstill_are_no_further_evidence_of_what_the_model_lacks() -> None:
    rig = shipped_rig("swdt82")
    training = simulated(RigTruth(rig, 7), 200, 7)
    model = identify(rig, rig_text("swdt82"), training, effects="none")
    thrice = training.select(np.repeat(np.arange(len(training)), 3))
    assert joint_error_scale(model, training) == 0.0
    assert joint_error_scale(model, thrice) == 0.0


@pytest.mark.long
def test_scatter_with_structure_is_the_models_even_where_lever_arms_do_not_show_it(session: Session) -> None:
    noisier = replace(session.model, excess_sigma_mm=4.0)
    scale = joint_error_scale(noisier, session.training, structured=True)
    assert joint_error_scale(noisier, session.training) == 0.0
    lin = Predictor.of(noisier).linearise(session.training)
    made = covariance_by_joints(lin.joint_jacobian, (scale * joint_error_sizes(session.rig)) ** 2)
    assert np.trace(made, axis1=1, axis2=2).mean() == pytest.approx(3.0 * 4.0**2, rel=0.02)


def test_prisms_of_a_standstill_are_no_further_evidence_of_what_the_model_lacks() -> None:
    """The readings of fifty standstills err the same way at each of their four prisms, and nothing else is wrong."""
    rig = shipped_rig("swdt82")
    table = simulate_observations(RigTruth(rig, 1001), 50, 1001, noise_mm=3.0).csv_text()
    training = parse_observations(table.encode(), rig, "simulated.csv")
    model = identify(rig, rig_text("swdt82"), training, effects="none")
    # Without a name of their pose, and with readings that are not the very same.
    theta4 = training.joints["theta4"] + np.arange(len(training)) * 1e-6
    joints = dict(training.joints) | {"theta4": theta4}
    alone = replace(training, pose=np.full(len(training), ""), joints=joints)
    assert joint_error_scale(model, alone) > 0.0  # what they would say were each a standstill of its own
    assert joint_error_scale(model, training) == 0.0
