"""Samples, start, refinement and the global search."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import UnsafeError
from calibration.identification.linear_model import prior_precision
from calibration.identification.noise import reading_covariance, reading_variance, station_covariance
from calibration.identification.refinement import refine
from calibration.identification.samples import averaged
from calibration.identification.search.global_search import search_globally
from calibration.identification.solve import place, solve
from calibration.identification.start import PRIOR_SCALE, approach, rigid_fit, rough_start
from calibration.kinematics.chain import Chain, Placement, rotation_about
from calibration.model.prediction import Predictor
from calibration.observations import Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from calibration.run_settings import Run
from simulators.rig.truth import RigTruth
from tests.bench.far_starts import moved
from tests.calibration.conftest import Session, rms, simulated
from tests.simulated.observations import simulate_observations


def blank(session: Session) -> Chain:
    return Chain(session.rig, {"": Placement.identity()})


# -- samples ---------------------------------------------------------------------------------------------------------


def test_repeats_of_a_standstill_become_one_sample_with_less_station_noise(session: Session) -> None:
    observations = simulated(session.truth, 240, 3, repeats=4)
    samples = averaged(blank(session), observations)
    assert len(samples) == 60
    np.testing.assert_allclose(samples.position_mm[0], observations.position_mm[:4].mean(axis=0))
    assert samples.of_row[:5].tolist() == [0, 0, 0, 0, 1]
    # 3 mm were drawn; the rig's station explains less, and repeats show the rest.
    single = np.trace(samples.station_covariance, axis1=1, axis2=2) * 4.0 / 3.0
    assert np.sqrt(single.mean()) == pytest.approx(3.0, rel=0.1)
    assert samples.repeat_variance > 1.0


def test_noise_that_repeats_of_a_standstill_do_not_show_is_not_averaged_out(session: Session) -> None:
    observations = simulated(session.truth, 240, 3, repeats=4)
    shared = np.repeat(np.random.default_rng(0).normal(0.0, 2.0, (60, 3)), 4, axis=0)
    sigma_mm = np.full((240, 3), np.hypot(3.0, 2.0))
    told = replace(observations, position_mm=observations.position_mm + shared, sigma_mm=sigma_mm)
    samples = averaged(blank(session), told)
    assert samples.repeat_variance == 0.0
    of_mean = np.trace(samples.station_covariance, axis1=1, axis2=2).mean() / 3.0
    assert of_mean == pytest.approx(2.0**2 + 3.0**2 / 4.0, rel=0.15)


def test_noise_of_readings_is_averaged_as_far_as_repeats_show_it(session: Session) -> None:
    rig, observations = session.rig, simulated(session.truth, 240, 3, repeats=4)
    chain, expected, rng = blank(session), reading_variance(rig), np.random.default_rng(1)
    same = {name: readings[::4].repeat(4) for name, readings in observations.joints.items()}
    own_sigma = dict(zip(rig.joint_names, np.sqrt(0.75 * expected), strict=True))
    noisy = {name: readings + own_sigma[name] * rng.normal(size=240) for name, readings in same.items()}
    steady = averaged(chain, replace(observations, joints=same))
    np.testing.assert_allclose(steady.shared_variance(rig), np.tile(expected, (len(steady), 1)))
    np.testing.assert_allclose(steady.own_variance(rig), 0.0, atol=1e-12 * expected.max())
    unsteady = averaged(chain, replace(observations, joints=noisy))
    np.testing.assert_allclose(unsteady.shared_variance(rig)[0], 0.25 * expected, atol=0.2 * expected.max())
    np.testing.assert_allclose(unsteady.own_variance(rig).mean(axis=0) / expected, 0.75 / 4.0, rtol=0.3)
    few = averaged(chain, replace(observations, joints=noisy).select(np.arange(8)))
    np.testing.assert_allclose(few.shared_variance(rig)[0], expected)


def test_a_repeat_that_disagrees_stands_alone(session: Session) -> None:
    observations = simulated(session.truth, 40, 3, repeats=4)
    position = observations.position_mm.copy()
    position[1] += 500.0
    samples = averaged(blank(session), replace(observations, position_mm=position))
    assert len(samples) == 11
    assert (samples.of_row == samples.of_row[1]).sum() == 1
    assert (samples.of_row == samples.of_row[0]).sum() == 3


def test_a_repeat_whose_joints_disagree_stands_alone(session: Session) -> None:
    observations = simulated(session.truth, 40, 3, repeats=4)
    theta4 = observations.joints["theta4"].copy()
    theta4[1] += 11.0
    samples = averaged(blank(session), replace(observations, joints={**observations.joints, "theta4": theta4}))
    assert len(samples) == 11
    assert (samples.of_row == samples.of_row[1]).sum() == 1
    found = samples.data.readings[:, session.rig.joint_names.index("theta4")]
    assert found[samples.of_row[1]] == theta4[1]
    assert found[samples.of_row[0]] == pytest.approx(theta4[[0, 2, 3]].mean())


def test_angles_on_both_sides_of_a_turn_are_averaged_the_short_way_round(session: Session) -> None:
    observations = simulated(session.truth, 4, 3, repeats=4)
    theta7 = np.array([179.99, -179.99, 179.99, -179.99])
    samples = averaged(blank(session), replace(observations, joints={**observations.joints, "theta7": theta7}))
    (found,) = samples.data.readings[:, session.rig.joint_names.index("theta7")]
    assert abs(found) == pytest.approx(180.0)


def test_a_turn_that_is_another_place_is_another_sample(session: Session) -> None:
    observations = simulated(session.truth, 4, 3, repeats=4)
    theta7 = observations.joints["theta7"] + [0.0, 0.0, 360.0, 0.0]
    again = replace(observations, joints={**observations.joints, "theta7": theta7})
    assert len(averaged(blank(session), again)) == 1
    rows = [row.model_copy(update={"drive": {"theta": {"theta7": 0.5}}}) for row in session.rig.rows[6:7]]
    geared = session.rig.model_copy(update={"rows": (*session.rig.rows[:6], *rows, *session.rig.rows[7:])})
    assert len(averaged(Chain(geared, {"": Placement.identity()}), again)) == 2


def test_fixes_without_a_pose_are_never_averaged(session: Session) -> None:
    observations = replace(session.training, pose=np.full(len(session.training), "", dtype=np.str_))
    assert len(averaged(blank(session), observations)) == len(observations)


def test_a_far_fix_is_uncertain_across_the_line_of_sight_and_sigma_columns_replace_the_instrument() -> None:
    rig = shipped_rig("swdt82")
    covariance = station_covariance(
        rig, np.array([[0.0, 200_000.0, 0.0]] * 2), np.array([[np.nan] * 3, [1.0, 2.0, 3.0]])
    )
    across, along = np.sqrt(covariance[0, 0, 0]), np.sqrt(covariance[0, 1, 1])
    assert across == pytest.approx(np.hypot(200_000 * np.radians(5 / 3600), 1.0))
    assert along == pytest.approx(np.hypot(2.0 + 2e-6 * 200_000, 1.0))
    np.testing.assert_allclose(covariance[1], np.diag([1.0, 4.0, 9.0]))


def test_a_moving_joint_adds_its_speed_times_the_timing_uncertainty() -> None:
    rig = shipped_rig("swdt82")
    jacobian = np.zeros((1, 3, len(rig.joints)))
    jacobian[0, 2, 0] = 100.0  # mm per deg
    still = reading_covariance(rig, jacobian, np.zeros((1, 9)))
    moving = reading_covariance(rig, jacobian, np.eye(1, 9) * 10.0)
    assert still[0, 2, 2] == pytest.approx(100.0**2 * (0.005**2 + 0.0055**2 / 12))
    assert moving[0, 2, 2] - still[0, 2, 2] == pytest.approx((100.0 * 10.0 * 0.005) ** 2)


# -- start -----------------------------------------------------------------------------------------------------------


def test_the_rigid_fit_recovers_a_placement() -> None:
    rng = np.random.default_rng(0)
    rotation = rotation_about(2, 2.5) @ rotation_about(0, 1.3)
    points = rng.normal(0, 1000, (10, 3))
    placement = rigid_fit(points, points @ rotation.T + [1.0, 2.0, 3.0], rng.uniform(0.5, 1, 10))
    np.testing.assert_allclose(placement.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(placement.translation_mm, [1.0, 2.0, 3.0], atol=1e-9)


def test_the_start_stands_beside_a_fifth_of_gross_outliers(session: Session) -> None:
    position = session.training.position_mm.copy()
    bad = np.random.default_rng(0).permutation(len(position))[:50]
    position[bad] += [4000.0, 2000.0, 0.0]
    chain = blank(session)
    clean = rough_start(chain, averaged(chain, session.training), np.zeros(len(chain))).placements[""]
    samples = averaged(chain, replace(session.training, position_mm=position))
    dirty = rough_start(chain, samples, np.zeros(len(chain))).placements[""]
    assert np.abs(clean.translation_mm - dirty.translation_mm).max() < 30.0
    assert np.abs(clean.rotation - dirty.rotation).max() < 0.01


@pytest.mark.parametrize(
    ("rows", "message"),
    [([0, 1], "2 fixes cannot place the base"), ([4, 4, 4], "1 fix cannot place the base")],
    ids=["two fixes", "one fix copied"],
)
def test_a_base_that_fixes_cannot_place_is_refused(session: Session, rows: list[int], message: str) -> None:
    few = session.training.select(np.array(rows))
    few = replace(few, pose=np.array(["", "", ""][: len(rows)]))
    with pytest.raises(UnsafeError, match=message):
        place(session.rig, few)


def test_mirrored_coordinates_are_refused_by_name(session: Session) -> None:
    swapped = replace(session.training, position_mm=session.training.position_mm[:, [1, 0, 2]])
    chain = blank(session)
    with pytest.raises(UnsafeError, match="mirrored"):
        rough_start(chain, averaged(chain, swapped), np.zeros(len(chain)))


def test_a_station_that_repeats_one_fix_is_told_so(session: Session) -> None:
    with pytest.raises(UnsafeError, match="all 250 fixes have the same coordinates"):
        place(session.rig, replace(session.training, position_mm=np.ones((250, 3))))


def test_fixes_on_a_line_cannot_place_a_base(session: Session) -> None:
    position = np.outer(np.arange(250.0), [10.0, 20.0, 30.0])
    with pytest.raises(UnsafeError, match="all fixes lie on a line"):
        place(session.rig, replace(session.training, position_mm=position))


# -- refinement ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size_mm", [30.0, 5000.0])
def test_a_fifth_of_gross_outliers_does_not_hurt(session: Session, size_mm: float) -> None:
    rng = np.random.default_rng(1)
    position = session.training.position_mm.copy()
    bad = rng.permutation(len(position))[:50]
    position[bad] += size_mm * rng.normal(size=(50, 3))
    chain, samples, start = place(session.rig, replace(session.training, position_mm=position))
    fit = refine(chain, samples, start.x)
    held = session.held_out
    floor = rms(held.position_mm - Predictor.of(session.model).geometric_mm(held))
    assert fit.converged
    assert rms(held.position_mm - chain.positions_mm(fit.x, chain.bind(held))) < 1.03 * floor
    far = np.linalg.norm(position[bad] - session.training.position_mm[bad], axis=1) > 40.0
    assert fit.weight[bad[far]].max() < 0.5
    assert (np.delete(fit.weight, bad) < 0.5).sum() <= 2


def test_tiny_sigma_columns_do_not_make_the_fit_chase_a_few_rows(session: Session) -> None:
    rng = np.random.default_rng(2)
    sigma = rng.choice([0.001, 0.1], (len(session.training), 1)) * np.ones(3)
    chain, samples, start = place(session.rig, replace(session.training, sigma_mm=sigma))
    fit = refine(chain, samples, start.x)
    held = session.held_out
    floor = rms(held.position_mm - Predictor.of(session.model).geometric_mm(held))
    assert np.sqrt(fit.excess_variance) == pytest.approx(3.0, rel=0.12)
    assert rms(held.position_mm - chain.positions_mm(fit.x, chain.bind(held))) < 1.01 * floor


def test_sigma_columns_that_are_true_leave_nothing_to_add(session: Session) -> None:
    sigma = np.full((len(session.training), 3), 3.0)
    chain, samples, start = place(session.rig, replace(session.training, sigma_mm=sigma))
    assert refine(chain, samples, start.x).excess_variance < 1.0


def test_as_built_estimates_how_far_the_machine_is_from_its_drawings(session: Session) -> None:
    far = RigTruth(session.rig, 11, perturbation=20.0)
    training, held = simulated(far, 250, 11), simulated(far, 300, 12)
    chain, samples, start = place(session.rig, training)
    fit = refine(chain, samples, start.x, prior="as-built")
    assert 14.0 < fit.prior_scale < 28.0
    assert rms(held.position_mm - chain.positions_mm(fit.x, chain.bind(held))) < 6.2


def test_held_parameters_do_not_move_and_a_given_excess_is_kept(session: Session) -> None:
    chain, samples, start = place(session.rig, session.training)
    free = np.array([p.kind == "base" for p in chain.parameters])
    fit = refine(chain, samples, start.x, free=free, excess_variance=4.0)
    np.testing.assert_array_equal(fit.x[~free], start.x[~free])
    assert fit.excess_variance == 4.0
    assert np.all(fit.covariance[~free] == 0.0)
    assert np.all(np.diag(fit.covariance)[free] > 0.0)


# -- far starts ------------------------------------------------------------------------------------------------------


def far(session: Session, seed: int) -> tuple[Rig, Observations]:
    """A machine of which every angle is up to 30 deg and every length up to 400 mm off the rig file, and its fixes."""
    rig, _ = moved(session.rig, seed, 30.0)
    data = simulate_observations(RigTruth(rig, seed, perturbation=0.0), 100, seed, noise_mm=3.0)
    return rig, parse_observations(data.csv_text().encode(), session.rig, "simulated.csv")


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_as_built_is_at_the_optimum_from_thirty_degrees_off(session: Session, outliers: float) -> None:
    for seed in (4, 8):  # the refinement alone comes to rest elsewhere
        _, observations = far(session, seed)
        clean_mm = observations.position_mm.copy()
        bad = np.random.default_rng(seed).random(len(clean_mm)) < outliers
        position_mm = clean_mm + bad[:, None] * np.random.default_rng(seed).normal(0.0, 3000.0, clean_mm.shape)
        chain, samples, start = place(session.rig, replace(observations, position_mm=position_mm))
        near = approach(chain, samples, start.x, precision=prior_precision(chain, PRIOR_SCALE["as-built"]))
        fit = refine(chain, samples, near, prior="as-built")
        assert rms(clean_mm - chain.positions_mm(fit.x, chain.bind(observations))) < 5.4


def test_recalibration_does_not_accept_a_machine_that_is_not_the_rig_files(session: Session) -> None:
    _, observations = far(session, 4)
    with ThreadPoolExecutor(2) as pool, pytest.raises(UnsafeError, match="--prior as-built"):
        solve(session.rig, observations, prior="recalibration", run=Run(0, pool))


# -- global search ---------------------------------------------------------------------------------------------------


def test_the_global_search_leads_the_refinement_to_the_optimum_by_itself(session: Session) -> None:
    chain, samples, start = place(session.rig, session.training)
    nominal = refine(chain, samples, start.x, free=np.isinf(chain.prior_sigma))
    with ThreadPoolExecutor(2) as pool:
        run = Run(0, pool)
        found, search = search_globally(chain, samples, nominal.x, nominal.x, start.scale_mm, "recalibration", run)
    assert found is not None
    assert search.complete
    data = session.training
    before, after = (rms(data.position_mm - chain.positions_mm(x, chain.bind(data))) for x in (nominal.x, found))
    assert after < 0.5 * before
    fit = refine(chain, samples, found)
    np.testing.assert_allclose(fit.x, session.model.values, atol=1e-2 * np.sqrt(np.diag(fit.covariance)).max())
