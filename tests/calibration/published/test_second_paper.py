"""The second paper's methods, as the paper has them: plain least squares, compliances, a network on the torques."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from calibration.effects.context import EffectContext
from calibration.effects.fitted import coefficient_values, corrected, fitted_columns
from calibration.errors import DataError, UnsafeError
from calibration.identification.solve import Solution, place
from calibration.kinematics.chain import Chain
from calibration.kinematics.torques import gravity_torques, torque_columns
from calibration.model.files import model_from_files, model_to_files
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import compensate_torques, identify
from calibration.published.second_paper import km, require_torques, skcm
from calibration.residual.features import Features, missing_signals, usable_torques
from calibration.residual.learners import LOADERS
from calibration.residual.rbf.torque_network import TorqueNetwork, fit_torque_network
from calibration.residual.selection import torque_compensation
from calibration.rig.description import ANOTHER_VALUE, Rig, parse_rig, shipped_rig
from calibration.run_settings import Run
from tests.calibration.conftest import features, rig_text, rms, simulated
from tests.calibration.simulated_ys100 import linear, robot, stiffening

RIGS = Path(__file__).parents[2] / "rigs"


def errors_mm(solution: Solution, x: Floats, observations: Observations) -> Floats:
    chain = solution.chain
    return observations.position_mm - chain.positions_mm(x[: len(chain)], chain.bind(observations))


# -- KM ----------------------------------------------------------------------------------------------------------------


def test_km_reaches_the_noise_where_kinematics_are_all_there_is() -> None:
    rig, training, held_out = robot(1, ())
    solution = km(rig, training, Run())
    assert solution.fit.converged
    assert solution.identifiability.rank == 27
    assert rms(errors_mm(solution, solution.fit.x, held_out)) < 0.15
    assert rms(errors_mm(solution, solution.nominal.x, held_out)) > 5.0


def test_km_is_the_least_squares_optimum_that_scipy_finds() -> None:
    rig, training, _ = robot(2, stiffening(2))
    solution = km(rig, training, Run())
    chain, _, start = place(rig, training)
    data = chain.bind(training)
    found = least_squares(
        lambda x: (chain.positions_mm(x, data) - training.position_mm).ravel(),
        start.x,
        jac=lambda x: chain.linearise(x, data).jacobian.reshape(-1, len(chain)),
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    squares = float((errors_mm(solution, solution.fit.x, training) ** 2).sum())
    assert squares == pytest.approx(2.0 * found.cost, rel=1e-6)


def test_km_leaves_what_the_data_cannot_see_where_it_was() -> None:
    rig, training, _ = robot(3, ())
    solution = km(rig, training, Run())
    chain, change = solution.chain, solution.fit.x - solution.nominal.x
    jacobian = chain.linearise(solution.nominal.x, chain.bind(training)).jacobian.reshape(-1, len(chain))
    length = np.linalg.norm(jacobian, axis=0)
    null = np.linalg.svd(jacobian / length)[2][27:]
    assert null.shape == (5, 32)
    assert np.abs(null @ (change * length)).max() < 1e-6 * np.linalg.norm(change * length)
    assert np.abs(change).max() > 1.0
    # The prior's uncertainty stays there, and no prediction has a share in it.
    sigma = np.sqrt(np.diag(solution.fit.covariance))
    assert sigma[chain.index("row2.d")] > 2.0
    spread = jacobian @ solution.fit.covariance @ jacobian.T
    assert np.sqrt(np.diag(spread)).max() < 0.5


def test_km_has_nothing_robust_about_it() -> None:
    rig, training, held_out = robot(4, ())
    position_mm = training.position_mm.copy()
    position_mm[7] += [300.0, 0.0, 0.0]
    solution = km(rig, replace(training, position_mm=position_mm), Run())
    assert rms(errors_mm(solution, solution.fit.x, held_out)) > 10.0
    assert (solution.fit.weight == 1.0).all()


def test_km_says_how_sure_it_is() -> None:
    squares = []
    for seed in range(5, 13):
        rig, training, held_out = robot(seed, ())
        solution = km(rig, training, Run())
        chain, fit = solution.chain, solution.fit
        lin = chain.linearise(fit.x, chain.bind(held_out))
        error = held_out.position_mm - lin.position_mm
        noise = 0.03**2 * np.eye(3) + lin.joint_jacobian @ lin.joint_jacobian.transpose(0, 2, 1) * 0.0005**2
        total = noise + lin.jacobian @ fit.covariance @ lin.jacobian.transpose(0, 2, 1)
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(total), error).mean() / 3.0)
    assert 0.8 < np.mean(squares) < 1.25


def test_km_takes_any_rig_and_several_set_ups(session) -> None:
    both = [simulated(session.truth, 150, 30 + i, setup=name) for i, name in enumerate(("A", "B"))]
    training = Observations(
        **{
            field: np.concatenate([getattr(o, field) for o in both])
            for field in ("prism", "position_mm", "sigma_mm", "setup", "session", "pose")
        },
        joints={k: np.concatenate([o.joints[k] for o in both]) for k in both[0].joints},
    )
    solution = km(session.rig, training, Run())
    assert solution.chain.setups == ("A", "B")
    assert rms(errors_mm(solution, solution.fit.x, training)) < 6.0


def test_too_few_fixes_and_mirrored_coordinates_are_refused_in_a_sentence() -> None:
    rig, training, _ = robot(5, ())
    with pytest.raises(UnsafeError, match=r"9 different poses cannot determine 27 parameters.*at least 10"):
        km(rig, training.select(np.arange(9)), Run())
    with pytest.raises(UnsafeError, match="mirrored"):
        km(rig, replace(training, position_mm=training.position_mm * [1.0, -1.0, 1.0]), Run())


def test_data_of_another_machine_are_refused() -> None:
    rig, training, _ = robot(6, ())
    shuffled = training.position_mm[np.random.default_rng(0).permutation(len(training))]
    with pytest.raises(UnsafeError, match="after plain least squares"):
        km(rig, replace(training, position_mm=shuffled), Run())


def test_what_km_makes_of_nearly_equal_parameters_is_no_mistake_of_the_rig_file() -> None:
    rig, table = shipped_rig("ur10"), Path(__file__).parents[2] / "data" / "ur10_random_poses.csv"
    every_eighth = parse_observations(table.read_bytes(), rig, table.name).select(np.arange(6, 2773, 8))
    model = identify(rig, rig_text("ur10"), every_eighth, method="km")
    assert max(abs(parameter.pull) for parameter in model.parameters) > ANOTHER_VALUE
    assert not [warning for warning in model.warnings if "file" in warning or "tolerances" in warning]


# -- SKCM --------------------------------------------------------------------------------------------------------------


def with_effects(found, observations: Observations) -> Floats:
    """Errors of kinematics and effects together, computed as a model does."""
    solution = found.solution
    x = solution.fit.x[: len(solution.chain)]
    additions = fitted_columns(found.effects, EffectContext(solution.chain, x, observations))
    names = solution.chain.rig.joint_names
    change = additions.change(coefficient_values(found.effects), len(names))
    return errors_mm(solution, x, corrected(observations, change, names))


def test_skcm_finds_linear_compliances_and_reaches_the_noise() -> None:
    truth = linear(1)
    rig, training, held_out = robot(1, truth)
    found = skcm(rig, training, Run())
    assert [e.where for e in found.effects] == ["theta2", "theta3", "theta4", "theta5", "theta6"]
    assert {e.family for e in found.effects} == {"joint_compliance"}
    for effect, hidden in zip(found.effects, truth, strict=True):
        (coefficient,) = effect.coefficients
        assert coefficient.name == "compliance_rad_per_Nm"
        # The masses of the rig file are within 10 % of this robot's.
        assert coefficient.value == pytest.approx(hidden.compliance_rad_per_Nm, rel=0.12)
        assert 0.0 < coefficient.standard_error < 0.15 * coefficient.value
    left = rms(errors_mm(found.solution, found.geometric.x, held_out))
    assert left > 0.5
    assert rms(with_effects(found, held_out)) < 0.15
    assert found.solution.additions is not None
    assert len(found.solution.fit.x) == len(found.solution.chain) + 5


def test_skcm_takes_measured_torques_where_the_rig_has_no_masses() -> None:
    rig, training, held_out = robot(2, linear(2))
    chain = Chain(rig, {})
    bare = rig.model_copy(update={"masses": ()})

    def measured(table: Observations) -> Observations:
        torques = gravity_torques(chain, np.zeros(len(chain)), table)
        return replace(table, extra={f"theta{i}_Nm": torques[:, i - 1] for i in (2, 3)})

    found = skcm(bare, measured(training), Run())
    assert [e.where for e in found.effects] == ["theta2", "theta3"]
    assert rms(with_effects(found, measured(held_out))) < 0.6 * rms(
        errors_mm(found.solution, found.geometric.x, held_out)
    )


@pytest.mark.parametrize("method", ["skcm", "rbf-tcm"])
def test_without_masses_and_without_measured_torques_the_method_is_refused(method: str) -> None:
    rig = parse_rig((RIGS / "arm7.toml").read_text(encoding="utf-8"), "arm7.toml")
    bare = shipped_rig("ys100").model_copy(update={"masses": ()})
    _, training, _ = robot(0, ())
    some = np.where(np.arange(len(training)) % 2 == 0, 100.0, np.nan)
    for data in (training, replace(training, extra={"theta2_Nm": some})):
        with pytest.raises(DataError, match=f"method {method} needs the torques of joints; add masses to rig 'ys100'"):
            require_torques(bare, data, method)
    joints = {j.name: np.linspace(*j.limits, len(training)) for j in rig.joints}
    with pytest.raises(DataError, match="'arm7'"):
        require_torques(rig, replace(training, joints=joints), method)


# -- RBF-TCM -----------------------------------------------------------------------------------------------------------


def left_by_km(solution: Solution, table: Observations) -> tuple[Features, Floats, tuple[str, ...]]:
    """What the network is trained on: features, residuals in the base frame, names of the torques."""
    chain, x = solution.chain, solution.fit.x
    names = usable_torques(chain, x, table)
    turned = errors_mm(solution, x, table) @ chain.base(x, 0).rotation
    return features(chain, x, table, names), turned, names


@pytest.fixture(scope="module")
def compensated() -> tuple[Solution, TorqueNetwork, Observations, Observations]:
    # The torques do not tell which way the robot faces: where joint 1 hardly turns they need not.
    rig, training, held_out = robot(4, stiffening(4), swing_deg=15.0)
    solution = km(rig, training, Run())
    seen, target, names = left_by_km(solution, training)
    labels = np.arange(len(training)).astype(np.str_)
    decision = torque_compensation(seen, target, labels, labels, names, seed=0)
    assert isinstance(decision.residual, TorqueNetwork)
    (trial,) = decision.trials
    assert trial.after_mm < trial.before_mm
    assert trial.kept
    assert (decision.variance_mm2 > 0.0).all()
    return solution, decision.residual, training, held_out


def test_the_network_lowers_the_error_of_poses_it_never_saw(compensated) -> None:
    solution, network, _, held_out = compensated
    seen, target, _ = left_by_km(solution, held_out)
    assert network.names == tuple(f"torque_theta{i}_Nm" for i in (2, 3, 4, 5, 6))
    assert 1 <= len(network.units) <= 40
    assert rms(target - network.predict(seen)) < 0.8 * rms(target)


def test_the_network_comes_back_from_its_files_the_same(compensated) -> None:
    solution, network, _, held_out = compensated
    seen, _, _ = left_by_km(solution, held_out)
    again = LOADERS["rbf-tcm"](network.to_files())
    np.testing.assert_array_equal(again.predict(seen), network.predict(seen))
    assert again.kind == "rbf-tcm"
    assert again.fits(seen)
    assert not again.fits(replace(seen, names=seen.names[:-1]))


def test_a_network_whose_parts_do_not_fit_is_refused(compensated) -> None:
    network = compensated[1]
    for broken in (replace(network, units=network.units[:, 1:]), replace(network, output=network.output[1:])):
        with pytest.raises(ValueError, match="arrays do not match"):
            TorqueNetwork.from_files(broken.to_files())
    with pytest.raises(KeyError):
        TorqueNetwork.from_files({})


def test_the_first_unit_stands_where_the_error_is_largest_and_units_are_never_more_than_forty() -> None:
    rng = np.random.default_rng(0)
    torques = rng.uniform(-100.0, 100.0, (90, 2))
    target = np.column_stack([np.sin(torques[:, 0] / 8.0), np.cos(torques[:, 1] / 9.0), rng.normal(0.0, 0.01, 90)])
    seen = Features(("q_deg", "torque_a_Nm", "torque_b_Nm"), np.zeros((90, 1)), torques, *2 * [np.empty((90, 3, 0))])
    labels = np.arange(90).astype(np.str_)
    network, _ = fit_torque_network(seen, target, labels, seen.names[1:], seed=0)
    assert len(network.units) <= 40
    worst = ((target - target.mean(axis=0)) ** 2).sum(axis=1).argmax()
    np.testing.assert_array_equal(network.units[0], torques[worst])
    assert rms(target - network.predict(seen)) < 0.5 * rms(target - target.mean(axis=0))


def test_too_few_rows_make_no_network() -> None:
    seen = Features(("torque_a_Nm",), np.empty((8, 0)), np.arange(8.0)[:, None], *2 * [np.empty((8, 3, 0))])
    labels = np.arange(8).astype(np.str_)
    decision = torque_compensation(seen, np.ones((8, 3)), labels, labels, seen.names, seed=0)
    assert decision.residual is None
    assert "8 fixes in 8 groups are too few" in decision.reason


def test_torques_are_features_in_training_and_prediction_alike() -> None:
    rig, training, _ = robot(1, ())
    chain = Chain(rig, {"": place(rig, training)[0].placements[""]})
    x = np.zeros(len(chain))
    seen = features(chain, x, training, ["payload_kg", "torque_theta3_Nm", "time_s"])
    np.testing.assert_array_equal(seen.columns(["torque_theta3_Nm"])[:, 0], gravity_torques(chain, x, training)[:, 2])
    assert np.isnan(seen.columns(["payload_kg"])).all()
    np.testing.assert_array_equal(seen.columns(["time_s"])[:, 0], training.extra["time_s"])


def test_a_torque_is_missing_only_where_it_can_be_neither_computed_nor_read() -> None:
    rig, training, _ = robot(1, ())
    bare = rig.model_copy(update={"masses": ()})
    signals = ("theta2_dir", "torque_theta3_Nm", "oil_bar")
    assert missing_signals(rig, training, signals) == ("oil_bar",)
    assert missing_signals(bare, training, signals) == ("theta3_Nm", "oil_bar")
    measured = replace(training, extra={**training.extra, "theta3_Nm": np.ones(len(training))})
    assert missing_signals(bare, measured, signals) == ("oil_bar",)
    assert torque_columns(bare) == torque_columns(rig)


def test_every_rig_with_masses_can_be_compensated() -> None:
    for name in ("swdt82", "ur10"):
        rig: Rig = shipped_rig(name)
        chain = Chain(rig, {})
        rng = np.random.default_rng(0)
        joints = {j.name: rng.uniform(*j.limits, 20) for j in rig.joints}
        blank = np.full(20, "")
        nothing = np.full((20, 3), np.nan)
        table = Observations(np.full(20, rig.prism_names[0]), joints, nothing, nothing, blank, blank, blank)
        require_torques(rig, table, "skcm")
        assert len(usable_torques(chain, np.zeros(len(chain)), table)) >= 4


def test_a_model_with_the_network_predicts_the_same_from_its_files(compensated) -> None:
    solution, _, training, held_out = compensated
    rig = solution.chain.rig
    with_network = compensate_torques(identify(rig, rig_text(rig.name), training, method="km"), training)
    correction = Predictor.of(with_network).correction(held_out)[0]
    assert rms(correction) > 0.05
    np.testing.assert_allclose(
        Predictor.of(model_from_files(model_to_files(with_network))).correction(held_out)[0], correction, atol=1e-9
    )
    assert not any("which this data lacks" in warning for warning in model_warnings(with_network, held_out))
