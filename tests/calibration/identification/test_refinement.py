"""Refinement: compiled Jacobians, correlated standstills, restricted likelihood, evidence, additions, intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from calibration.effects.columns import EffectColumns
from calibration.errors import CalibrationError
from calibration.identification.linear_model import information, prior_precision
from calibration.identification.refinement import Fit, Prior, posterior, refine
from calibration.identification.samples import Samples, averaged
from calibration.identification.solve import place
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats, Observations, parse_observations
from calibration.rig.description import Rig, shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rms
from tests.calibration.interval_coverage import Setting, covered
from tests.calibration.interval_coverage import session as session_errors
from tests.simulated.observations import simulate_observations


def standstills(truth: RigTruth, poses: int, seed: int, noise_mm: float = 3.0) -> Observations:
    """All prisms in every pose."""
    data = simulate_observations(truth, poses, seed, prisms_per_pose="all", noise_mm=noise_mm)
    return parse_observations(data.csv_text().encode(), truth.rig, "simulated.csv")


@pytest.fixture(scope="module")
def noisy_joints() -> Rig:
    """Readings so poor that what they share matters: 0.05 deg and 2 mm."""
    rig = shipped_rig("swdt82")
    joints = [j.model_copy(update={"sigma": 0.05 if j.kind == "revolute" else 2.0}) for j in rig.joints]
    return rig.model_copy(update={"joints": tuple(joints)})


def unsteady(observations: Observations, rig: Rig) -> Observations:
    """Two fixes of each, whose readings differ by a half of what they may."""
    twice, rng = observations.select(np.repeat(np.arange(len(observations)), 2)), np.random.default_rng(5)
    joints = {j.name: twice.joints[j.name] + 0.5 * j.sigma * rng.normal(size=len(twice)) for j in rig.joints}
    return replace(twice, joints=joints)


@pytest.fixture(scope="module", params=["readings that stand", "readings that scatter", "unknown joints"])
def fitted(request: pytest.FixtureRequest, noisy_joints: Rig) -> tuple[Chain, Samples, Fit]:
    observations = standstills(RigTruth(noisy_joints, 21), 40, 21)
    if request.param == "readings that scatter":
        observations = unsteady(observations, noisy_joints)
    chain, samples, start = place(noisy_joints, observations)
    if request.param == "unknown joints":
        unknown = np.where(np.arange(len(samples))[:, None] % 3 == 0, samples.shared_variance(noisy_joints), 0.0)
        samples = replace(samples, unknown_variance=unknown)
    return chain, samples, refine(chain, samples, start.x)


def dense(chain: Chain, samples: Samples, x: Floats, excess: float) -> tuple[Floats, Floats, Floats]:
    """Covariance (3 m, 3 m) of all samples as the textbook has it, Jacobian (3 m, p) and error (3 m,)."""
    lin = chain.linearise(x, samples.data)
    assert samples.standstill is not None
    together = np.kron(samples.standstill[:, None] == samples.standstill, np.ones((3, 3)))
    by_joint = lin.joint_jacobian.reshape(3 * len(samples), -1)
    shared = by_joint * np.sqrt(np.repeat(samples.shared_variance(chain.rig), 3, axis=0))
    covariance = together * (shared @ shared.T)
    covariance += block_diag(*samples.station_covariance) + excess * np.eye(len(covariance))
    own = samples.own_variance(chain.rig)
    for row, (jacobian, rate) in enumerate(zip(lin.joint_jacobian, samples.rates, strict=True)):
        velocity = jacobian @ rate * chain.rig.station.timing_sigma_s
        block = np.outer(velocity, velocity) + (jacobian * own[row]) @ jacobian.T
        covariance[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] += block
    return covariance, lin.jacobian.reshape(len(covariance), -1), (samples.position_mm - lin.position_mm).ravel()


# -- samples ---------------------------------------------------------------------------------------------------------


def test_prisms_of_one_pose_share_their_standstill_and_poses_do_not(noisy_joints: Rig) -> None:
    table = standstills(RigTruth(noisy_joints, 21), 10, 21)
    chain = Chain(noisy_joints, {"": Placement.identity()})
    shared = averaged(chain, table).standstill
    assert shared is not None
    assert shared.tolist() == np.repeat(shared[::4], 4).tolist()
    assert len(set(shared.tolist())) == 10
    unlabelled = averaged(chain, replace(table, pose=np.full(len(table), "", dtype=np.str_))).standstill
    assert unlabelled is not None
    assert unlabelled.tolist() == shared.tolist()  # the very same readings of all joints are one standstill
    theta4 = table.joints["theta4"] + np.arange(len(table)) * 1e-6
    apart = replace(table, pose=np.full(len(table), "", dtype=np.str_), joints=dict(table.joints) | {"theta4": theta4})
    assert len(set(averaged(chain, apart).standstill.tolist())) == 40


def test_a_fix_with_other_readings_than_its_pose_is_a_standstill_of_its_own(noisy_joints: Rig) -> None:
    table = standstills(RigTruth(noisy_joints, 21), 3, 21)
    theta4 = table.joints["theta4"].copy()
    theta4[0] += 5.0
    moved = replace(table, joints={**table.joints, "theta4": theta4})
    shared = averaged(Chain(noisy_joints, {"": Placement.identity()}), moved).standstill
    assert shared is not None
    assert np.unique(shared, return_counts=True)[1].tolist() == [1, 3, 4, 4]
    assert (shared == shared[0]).sum() == 1


def test_columns_are_averaged_as_the_fixes_are(session: Session) -> None:
    data = simulate_observations(session.truth, 5, 3, prisms_per_pose="one", repeats=3)
    table = parse_observations(data.csv_text().encode(), session.rig, "simulated.csv")
    samples = averaged(Chain(session.rig, {"": Placement.identity()}), table)
    columns = np.arange(30.0).reshape(15, 2)
    np.testing.assert_allclose(samples.average(columns), columns.reshape(5, 3, 2).mean(axis=1))


# -- noise -----------------------------------------------------------------------------------------------------------


def test_the_information_is_that_of_the_whole_covariance(fitted: tuple[Chain, Samples, Fit]) -> None:
    chain, samples, fit = fitted
    rates = np.random.default_rng(0).normal(0.0, 20.0, samples.rates.shape)
    moving = replace(samples, rates=rates * (np.arange(len(samples)) % 3 == 0)[:, None])
    covariance, jacobian, _ = dense(chain, moving, fit.x, 4.0)
    expected = jacobian.T @ np.linalg.solve(covariance, jacobian)
    found = information(chain, moving, fit.x, excess_variance=4.0)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-9)


def test_a_row_of_no_weight_is_as_if_it_were_not_there(fitted: tuple[Chain, Samples, Fit]) -> None:
    chain, samples, fit = fitted
    weight = (np.random.default_rng(1).random(len(samples)) > 0.3).astype(float)
    covariance, jacobian, _ = dense(chain, samples, fit.x, 4.0)
    there = np.repeat(weight > 0.0, 3)
    left = jacobian[there]
    expected = left.T @ np.linalg.solve(covariance[np.ix_(there, there)], left)
    found = information(chain, samples, fit.x, excess_variance=4.0, weight=weight)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_excess_maximises_the_restricted_likelihood(fitted: tuple[Chain, Samples, Fit]) -> None:
    chain, samples, fit = fitted
    assert fit.weight.min() > 0.9
    precision = np.diag(prior_precision(chain, 1.0))

    def restricted(excess: float) -> float:
        covariance, jacobian, error = dense(chain, samples, fit.x, excess)
        # e + J x is what the linear model explains, the prior about zero included.
        wide = covariance + jacobian @ np.linalg.solve(precision, jacobian.T)
        target = error + jacobian @ fit.x
        return -0.5 * float(np.linalg.slogdet(wide)[1] + target @ np.linalg.solve(wide, target))

    sizes = fit.excess_variance * np.array([0.97, 1.0, 1.03])
    low, here, high = (restricted(size) for size in sizes)
    assert here > max(low, high)


def test_the_cost_is_the_negative_log_evidence(fitted: tuple[Chain, Samples, Fit]) -> None:
    chain, samples, fit = fitted
    precision = np.diag(prior_precision(chain, 1.0))
    found, expected = [], []
    for excess in (6.0, 12.0):
        at = refine(chain, samples, fit.x, excess_variance=excess)
        covariance, jacobian, error = dense(chain, samples, at.x, excess)
        wide = covariance + jacobian @ np.linalg.solve(precision, jacobian.T)
        target = error + jacobian @ at.x
        found.append(at.cost)
        expected.append(0.5 * float(np.linalg.slogdet(wide)[1] + target @ np.linalg.solve(wide, target)))
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=0.05)


def test_the_covariance_at_a_given_point_is_that_of_the_refinement_which_ends_there(
    fitted: tuple[Chain, Samples, Fit],
) -> None:
    chain, samples, fit = fitted
    there = posterior(chain, samples, fit.x)
    np.testing.assert_array_equal(there.x, fit.x)
    np.testing.assert_allclose(np.diag(there.covariance), np.diag(fit.covariance), rtol=1e-2)
    assert there.cost == pytest.approx(fit.cost, abs=0.05)
    away = posterior(chain, samples, fit.x + 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert away.cost > fit.cost + 10.0


def test_a_fifth_of_gross_outliers_among_whole_poses_does_not_hurt(session: Session) -> None:
    table = standstills(session.truth, 70, 5)
    rng = np.random.default_rng(4)
    bad = rng.permutation(len(table))[: len(table) // 5]
    position = table.position_mm.copy()
    position[bad] += 2000.0 * rng.normal(size=(len(bad), 3))
    held = session.held_out
    errors = []
    for rows in (table, replace(table, position_mm=position)):
        chain, samples, start = place(session.rig, rows)
        fit = refine(chain, samples, start.x)
        assert fit.converged
        errors.append(rms(held.position_mm - chain.positions_mm(fit.x, chain.bind(held))))
    assert errors[1] < 1.03 * errors[0]
    assert fit.weight[bad].max() < 0.5
    assert (np.delete(fit.weight, bad) < 0.5).sum() <= 2


def test_numbers_out_of_range_are_an_error_and_no_answer(fitted: tuple[Chain, Samples, Fit]) -> None:
    chain, samples, fit = fitted
    with pytest.raises(CalibrationError, match="left the range of floating point"):
        refine(chain, samples, np.where(np.arange(len(chain)) == 1, np.nan, fit.x))
    empty = EffectColumns(
        ("nothing@theta4:nothing",), np.array([2]), np.full((len(samples), 1), np.nan), np.array([1.0])
    )
    with pytest.raises(CalibrationError, match="left the range of floating point"):
        refine(chain, samples, fit.x, additions=empty)


# -- additions -------------------------------------------------------------------------------------------------------


def test_coefficients_of_effects_are_found_with_the_kinematics(session: Session) -> None:
    table = session.training
    joint = session.rig.joint_names.index("theta4")
    angle = np.radians(table.joints["theta4"])
    columns = np.column_stack([np.sin(4.0 * angle), np.cos(4.0 * angle)])
    true = np.array([0.2, -0.15])
    read = replace(table, joints={**table.joints, "theta4": table.joints["theta4"] - columns @ true})
    chain, samples, start = place(session.rig, read)
    names = ("encoder_harmonic@theta4:sine", "encoder_harmonic@theta4:cosine")
    additions = EffectColumns(names, np.array([joint, joint]), samples.average(columns), np.array([0.3, 0.3]))
    without, fit = refine(chain, samples, start.x), refine(chain, samples, start.x, additions=additions)
    p = len(chain)
    assert fit.x.shape == (p + 2,)
    assert fit.covariance.shape == (p + 2, p + 2)
    assert fit.cost < without.cost - 20.0
    sigma = np.sqrt(np.diag(fit.covariance))[p:]
    assert np.all(sigma < 0.05)
    assert np.all(np.abs(fit.x[p:] - true) < 3.0 * sigma)
    assert np.all(np.abs(fit.covariance[:p, p:]).max(axis=0) > 0.0)


def test_the_scale_of_build_tolerances_leaves_the_prior_of_effects_alone(session: Session) -> None:
    chain, samples, start = place(session.rig, session.training)
    still = EffectColumns(("nothing@theta4:nothing",), np.array([2]), np.zeros((len(samples), 1)), np.array([0.7]))
    fit = refine(chain, samples, start.x, prior="as-built", additions=still)
    assert np.sqrt(fit.covariance[-1, -1]) == pytest.approx(0.7)


def test_an_estimated_prior_scale_leaves_what_the_data_do_not_see_less_certain(session: Session) -> None:
    near = np.isin(session.training.prism, ("w", "b"))  # rows 6 to 9 move neither
    chain, samples, start = place(session.rig, session.training.select(near))
    blind = [chain.index(name) for name in ("row6.a", "row7.d", "row9.theta", "prism.r.x")]

    def share(prior: Prior) -> Floats:
        fit = refine(chain, samples, start.x, prior=prior)
        return np.diag(fit.covariance)[blind] / (fit.prior_scale * chain.prior_sigma[blind]) ** 2

    np.testing.assert_allclose(share("recalibration"), 1.0)
    # The mean of an inverse chi-square of gamma degrees of freedom: no more of them than parameters that are seen.
    determined = 2.0 + 2.0 / (share("as-built") - 1.0)
    np.testing.assert_allclose(determined, determined[0])
    assert 5.0 < determined[0] < 28.0


def test_additions_of_other_rows_are_refused(session: Session) -> None:
    chain, samples, start = place(session.rig, session.training)
    other = EffectColumns(("nothing@theta4:nothing",), np.array([2]), np.zeros((3, 1)), np.array([1.0]))
    with pytest.raises(ValueError, match=r"3 rows for \d+ samples"):
        refine(chain, samples, start.x, additions=other)


# -- intervals -------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "setting",
    [
        Setting(prisms_per_pose="one"),
        Setting(prisms_per_pose="all", outliers=0.05),
        Setting(prisms_per_pose="all", prior="as-built"),
    ],
    ids=["one prism a pose", "all prisms, outliers", "as built"],
)
def test_intervals_of_95_percent_cover_the_truth(setting: Setting) -> None:
    sessions = [session_errors(setting, seed) for seed in range(2000, 2016)]
    for name in ("parameter", "prediction", "fix"):
        found = covered([getattr(s, name) for s in sessions])
        # 93 to 97 %, as far as so few sessions can tell.
        assert abs(found.share - 0.95) < 0.02 + 2.0 * found.standard_error, name
        assert found.standard_error < 0.02
