from __future__ import annotations

import numpy as np
import pytest

from calibration.observations import parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.noise import coordinate_sigma_mm, station_covariance_mm2, station_measured_mm
from simulators.rig.truth import RigTruth, replace_effects
from tests.simulated.observations import simulate_observations


def test_the_csv_is_the_contracts_and_reads_back_exactly(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 10, 2, sigma_columns=True, setup="S1", session="a")
    table = parse_observations(data.csv_text().encode(), swdt82, "sim.csv")
    assert len(table) == 40
    assert table.ignored_columns == ()
    assert np.array_equal(table.position_mm, data.measured_mm)
    assert np.array_equal(table.joints["theta4"], data.columns["theta4_deg"])
    assert set(table.setup) == {"S1"}
    assert set(table.session) == {"a"}
    assert {"time_s", "dwell_s", "L2_dir", "theta1_rate"} <= set(table.extra)
    assert np.all(np.diff(table.extra["time_s"]) > 0)


def test_the_same_seed_gives_the_same_file(swdt82: Rig) -> None:
    texts = [simulate_observations(RigTruth(swdt82, 1), 5, s).csv_text() for s in (3, 3, 4)]
    assert texts[0] == texts[1]
    assert texts[0] != texts[2]


@pytest.mark.parametrize("name", ["swdt82", "ys100", "ur10"])
def test_without_noise_measurement_oracle_and_truth_are_one(name: str) -> None:
    rig = shipped_rig(name)
    truth = RigTruth(rig, 1)
    data = simulate_observations(truth, 6, 2, noise_mm=0.0, joint_noise=False)
    assert data.noise_rms_mm == 0.0
    joints = {j.name: data.columns[j.column].astype(float) for j in rig.joints}
    rows = data.columns["prism"] == rig.prism_names[0]
    want = truth.prism_mm(rig.prism_names[0], {k: v[rows] for k, v in joints.items()})
    assert np.allclose(data.measured_mm[rows], want)


def test_the_oracle_is_the_truth_at_the_read_joints(swdt82: Rig) -> None:
    truth = RigTruth(swdt82, 1)
    data = simulate_observations(truth, 50, 2, prisms=["r"], noise_mm=0.0)
    joints = {j.name: data.columns[j.column].astype(float) for j in swdt82.joints}
    assert np.allclose(data.oracle_mm, truth.prism_mm("r", joints))
    # Encoder noise of some 0.005 deg at up to 12 m: of the order of a millimetre, never ten.
    assert 0.3 < data.noise_rms_mm < 5.0


def test_isotropic_noise_has_the_size_asked_for(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 500, 2, noise_mm=3.0, joint_noise=False)
    assert data.noise_rms_mm == pytest.approx(3.0 * np.sqrt(3), rel=0.05)


def test_readings_are_multiples_of_the_resolution(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 20, 2)
    steps = data.columns["L2_mm"].astype(float) / 0.1
    assert np.allclose(steps, np.rint(steps), atol=1e-6)


def test_fixes_of_a_pose_share_their_readings_and_repeats_show_the_noise(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 30, 2, prisms=["r", "s"], repeats=3)
    pose, angle = data.columns["pose"], data.columns["theta4_deg"]
    for p in np.unique(pose):
        assert len(np.unique(angle[pose == p])) == 1
        assert list(data.columns["prism"][pose == p]) == ["r"] * 3 + ["s"] * 3
    first = data.measured_mm.reshape(-1, 3, 3)
    spread = np.sqrt(np.mean(np.var(first, axis=1, ddof=1).sum(axis=1)))
    assert 2.0 < spread < 5.0


def test_one_prism_a_pose_takes_turns(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 9, 2, prisms_per_pose="one")
    assert list(data.columns["prism"]) == list("wbrswbrsw")
    assert len(set(data.columns["pose"])) == 9


def test_directions_are_those_of_the_last_move(swdt82: Rig) -> None:
    data = simulate_observations(RigTruth(swdt82, 1), 40, 2, prisms=["r"], joint_noise=False)
    moved = np.sign(np.diff(data.columns["theta3_deg"].astype(float)))
    assert np.array_equal(moved, data.columns["theta3_dir"].astype(float)[1:])


def test_station_noise_matches_its_covariance_and_its_sigma_columns(swdt82: Rig) -> None:
    rng = np.random.default_rng(0)
    true = np.array([3000.0, -9000.0, 4000.0])
    measured = station_measured_mm(swdt82.station, np.tile(true, (20000, 1)), rng)
    covariance = station_covariance_mm2(swdt82.station, true[None])
    expected, sigma = covariance[0], coordinate_sigma_mm(covariance)
    assert abs(expected[0, 1]) > 0.5  # what makes the range errs x and y together
    assert np.allclose(np.cov(measured.T), expected, atol=0.15)
    assert np.allclose((measured - true).std(axis=0), sigma[0], rtol=0.03)
    assert np.allclose(measured.mean(axis=0), true, atol=0.1)


def test_a_hidden_effect_is_in_the_oracle_too(swdt82: Rig) -> None:
    plain = RigTruth(swdt82, 1)
    hidden = replace_effects(plain, parse_effects("boom_droop@boom,backlash@theta4:width_rad=2e-3"))
    a, b = (simulate_observations(t, 50, 2, prisms=["r"], noise_mm=1.0) for t in (plain, hidden))
    assert b.noise_rms_mm == pytest.approx(a.noise_rms_mm, rel=0.05)
    assert np.sqrt(np.mean(np.sum((a.measured_mm - b.measured_mm) ** 2, axis=1))) > 5.0


def test_given_poses_are_held(swdt82: Rig) -> None:
    poses = {j.name: np.linspace(*j.limits, 5) for j in swdt82.joints}
    data = simulate_observations(RigTruth(swdt82, 1), 5, 2, poses=poses, prisms=["w"], joint_noise=False)
    assert np.array_equal(data.columns["theta8_deg"], poses["theta8"])
