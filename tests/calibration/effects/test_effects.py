"""Named effects: what each family promises, what the data may choose, and what a model makes of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.effects.context import EffectContext
from calibration.effects.fitted import coefficient_values, fitted_columns
from calibration.effects.library import library
from calibration.errors import DataError, ModelError
from calibration.gap.adoption import Adopted, adopt
from calibration.gap.search import search
from calibration.identification.solve import Solution, solve
from calibration.kinematics.chain import Chain, Placement
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.model.warnings import model_warnings
from calibration.observations import Observations, parse_observations
from calibration.pipeline.build_model import with_effects
from calibration.pipeline.calibrate import identify
from calibration.published.second_paper import skcm
from calibration.rig.description import Rig, shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects as simulated_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text, rms
from tests.calibration.model.test_model import edited
from tests.calibration.simulated_ys100 import robot, stiffening
from tests.simulated.observations import simulate_observations


def measured(rig: Rig, effects: str, n: int, seed: int, *, noise_mm: float, perturbation: float = 1.0) -> Observations:
    truth = RigTruth(rig, 5, perturbation=perturbation, effects=simulated_effects(effects))
    table = simulate_observations(truth, n, seed, prisms_per_pose="one", noise_mm=noise_mm, joint_noise=noise_mm > 0.0)
    return parse_observations(table.csv_text().encode(), rig, "simulated.csv")


def nominal_context(rig: Rig, observations: Observations) -> EffectContext:
    chain = Chain(rig, {"": Placement.identity()})
    return EffectContext(chain, np.zeros(len(chain)), observations)


def solved(rig: Rig, observations: Observations) -> Solution:
    with ThreadPoolExecutor(2) as pool:
        return solve(rig, observations, prior="recalibration", run=Run(0, pool))


# -- curves of stiffness -----------------------------------------------------------------------------------------------


def test_a_curve_of_stiffness_is_symmetric_or_not_and_straight_beyond_its_data() -> None:
    family = library()["joint_compliance"]
    rig = shipped_rig("swdt82").model_copy(update={"masses": ()})
    torque = np.linspace(-2000.0, 2000.0, 81)
    blank = measured(shipped_rig("swdt82"), "", 81, 3, noise_mm=3.0)
    context = nominal_context(rig, replace(blank, extra={"theta4_Nm": torque}))
    symmetric = {"torque_Nm": 1000.0, "knot_power": 2.0, "bend_rad": 1e-3}
    columns = family.columns(context, "theta4", symmetric)
    np.testing.assert_allclose(columns, -columns[::-1], atol=1e-9 * np.abs(columns).max())
    for settings in (symmetric, {"low_Nm": -500.0, "high_Nm": 1000.0, "bend_rad": 1e-3}):
        second = np.diff(family.columns(context, "theta4", settings), 2, axis=0)
        outside = (torque[1:-1] < -1050.0) | (torque[1:-1] > 1050.0)
        assert np.abs(second[outside]).max() < 1e-9 * np.abs(second).max()
        assert (np.abs(second[:, 1:]).max(axis=0) > 0.0).all()


def test_loads_that_are_not_measured_everywhere_act_where_they_are() -> None:
    rig = shipped_rig("swdt82").model_copy(update={"masses": ()})
    torque = np.where(np.arange(30) < 20, 1000.0, np.nan)
    blank = measured(shipped_rig("swdt82"), "", 30, 3, noise_mm=3.0)
    context = nominal_context(rig, replace(blank, extra={"theta4_Nm": torque}))
    column = library()["joint_compliance"].columns(context, "theta4", {})
    np.testing.assert_allclose(column[:20, 0], np.degrees(1000.0))
    np.testing.assert_array_equal(column[20:], 0.0)


# -- what the data ask for ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fitted:
    """A simulated YS100 with reducers that stiffen: training and held-out poses, kinematics alone and with effects."""

    rig: Rig
    training: Observations
    held_out: Observations
    adopted: Adopted
    kinematics: CalibratedModel
    model: CalibratedModel


@pytest.fixture(scope="module")
def stiff() -> Fitted:
    rig, training, held_out = robot(3, stiffening(3))
    adopted = search(solved(rig, training), training, library()).adopted
    kinematics = identify(rig, rig_text("ys100"), training, effects="none")
    return Fitted(rig, training, held_out, adopted, kinematics, with_effects(kinematics, adopted))


def test_stiffening_reducers_are_found_and_held_out_errors_fall_to_the_noise(stiff: Fitted) -> None:
    assert {e.where for e in stiff.model.effects} >= {"theta2", "theta3", "theta5"}
    geometric = stiff.held_out.position_mm - Predictor.of(stiff.model).geometric_mm(stiff.held_out)
    effects = stiff.held_out.position_mm - Predictor.of(stiff.model).effects_mm(stiff.held_out)
    assert rms(effects) < 0.25 * rms(geometric)
    assert rms(effects) < 2.0 * 0.03 * np.sqrt(3.0)
    assert "joint_compliance@theta2" in stiff.model.effects_reason


@pytest.mark.long
def test_springs_of_all_joints_together_are_no_formula_of_the_base() -> None:
    """Beside the first of five, one moment about the base explains nearly as much as the next two together."""
    rig, training, _ = robot(2019, stiffening(2019))
    adopted = search(solved(rig, training), training, library()).adopted
    assert {(e.family, e.where) for e in adopted.effects} == {("joint_compliance", f"theta{n}") for n in range(2, 7)}


@pytest.mark.long
@pytest.mark.parametrize("seed", [2012, 3007, 3018])
def test_the_few_poses_under_loads_that_no_other_has_show_the_curve_and_are_no_outliers(seed: int) -> None:
    """Joint 2 is pulled one way in all poses but one to three."""
    rig, training, held_out = robot(seed, stiffening(seed))
    adopted = search(solved(rig, training), training, library()).adopted
    assert (adopted.solution.fit.weight > 0.5).all()
    model = with_effects(identify(rig, rig_text("ys100"), training, effects="none"), adopted)
    assert np.linalg.norm(held_out.position_mm - Predictor.of(model).effects_mm(held_out), axis=1).max() < 0.3


def test_what_a_prediction_with_effects_says_of_its_own_error_holds(stiff: Fitted) -> None:
    prediction = Predictor.of(stiff.model).predict(stiff.held_out)
    np.testing.assert_array_equal(prediction.position_mm, Predictor.of(stiff.model).effects_mm(stiff.held_out))
    pull = (stiff.held_out.position_mm - prediction.position_mm) / prediction.sigma_mm
    assert 0.6 < np.sqrt((pull**2).mean()) < 1.5
    assert stiff.model.noise_mm < 0.5 * stiff.kinematics.noise_mm


def test_robots_without_effects_get_none() -> None:
    for seed in range(4):
        rig, training, _ = robot(seed, ())
        adopted = search(solved(rig, training), training, library()).adopted
        assert adopted.effects == ()
        assert adopted.solution.fit is adopted.geometric


def test_a_boom_without_effects_gets_none(session: Session) -> None:
    assert search(solved(session.rig, session.training), session.training, library()).adopted.effects == ()


@pytest.mark.long
@pytest.mark.parametrize("name", ["swdt82", "ys100"])
def test_data_without_any_noise_get_no_effect_and_no_failure(name: str) -> None:
    rig = shipped_rig(name)
    observations = measured(rig, "", 80, 4, noise_mm=0.0)
    exact = replace(observations, sigma_mm=np.full((80, 3), 1e-4))
    for table in (observations, exact):
        assert search(solved(rig, table), table, library()).adopted.effects == ()


@pytest.mark.long
def test_a_few_gross_outliers_do_not_hide_a_compliance(stiff: Fitted) -> None:
    moved = stiff.training.position_mm.copy()
    moved[[5, 25]] += [80.0, -50.0, 60.0]
    training = replace(stiff.training, position_mm=moved)
    adopted = search(solved(stiff.rig, training), training, library()).adopted
    assert {e.where for e in adopted.effects} >= {"theta2", "theta3"}
    assert adopted.solution.fit.weight[[5, 25]].max() < 0.01
    assert adopted.solution.fit.excess_variance < 0.1 * adopted.geometric.excess_variance


def test_effects_can_be_switched_off_or_asked_for_by_name(session: Session) -> None:
    rig = session.rig
    observations = measured(rig, "backlash@theta4:width_rad=3e-3", 250, 11, noise_mm=3.0)
    solution = solved(rig, observations)
    assert adopt(solution, observations, "none") == Adopted(solution, solution.fit)
    adopted = adopt(solution, observations, "backlash@theta4,encoder_harmonic@theta6")
    backlash, harmonic = adopted.effects
    (width,) = backlash.coefficients
    assert abs(width.value - 3e-3) < 3.0 * width.standard_error < 1e-3
    assert [c.name for c in harmonic.coefficients] == ["cosk_rad", "sink_rad"]
    assert harmonic.settings["k"] in (1.0, 2.0)
    without = replace(observations, extra={})
    with pytest.raises(DataError, match="backlash@theta4 needs the column theta4_dir"):
        adopt(solution, without, "backlash@theta4")
    with pytest.raises(ValueError, match="unknown"):
        adopt(solution, observations, "droop@theta4")


def test_a_vertical_axis_carries_nothing(stiff: Fitted) -> None:
    with pytest.raises(DataError, match="joint_compliance@theta1 has no effect in any pose"):
        adopt(stiff.adopted.solution, stiff.training, "joint_compliance@theta1")


def test_the_compliances_of_the_second_paper_become_effects(stiff: Fitted) -> None:
    adopted = skcm(stiff.rig, stiff.training, Run())
    solution = adopted.solution
    assert solution.additions is not None
    names = [f"{e.family}@{e.where}:{e.coefficients[0].name}" for e in adopted.effects]
    assert names == list(solution.additions.names)
    np.testing.assert_array_equal(coefficient_values(adopted.effects), solution.fit.x[len(solution.chain) :])


# -- in a model --------------------------------------------------------------------------------------------------------


def test_a_model_with_effects_comes_back_as_it_was_written(stiff: Fitted) -> None:
    files = model_to_files(stiff.model)
    again = model_from_files(files)
    assert model_to_files(again) == files
    assert again.effects == stiff.model.effects
    np.testing.assert_array_equal(
        Predictor.of(again).effects_mm(stiff.held_out), Predictor.of(stiff.model).effects_mm(stiff.held_out)
    )
    np.testing.assert_array_equal(
        Predictor.of(again).geometric_mm(stiff.held_out), Predictor.of(stiff.kinematics).geometric_mm(stiff.held_out)
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"family": "gremlins"}, "gremlins@theta2, which this program does not have there"),
        ({"where": "theta77"}, "joint_compliance@theta77, which this program does not have there"),
        ({"settings": {"torque_Nm": -1.0, "knot_power": 1.0, "bend_rad": 1.0}}, "in an invalid form"),
        ({"settings": {}}, "needs the coefficients compliance_rad_per_Nm"),
        ({"settings": {"torque_Nm": float("nan")}}, "settings"),
        ({"coefficients": []}, "does not match the parameters and effects"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_signed_effects_that_this_program_would_compute_otherwise_are_refused(
    stiff: Fitted, changes: Mapping[str, object], message: str
) -> None:
    files = model_to_files(stiff.model)
    first, *others = sorted(json.loads(files["model.json"])["effects"], key=lambda e: str(e["where"]))
    with pytest.raises(ModelError, match=message):
        model_from_files(edited(files, effects=[{**first, **changes}, *others]))


def test_a_model_does_without_an_effect_whose_column_is_missing_and_says_so(session: Session) -> None:
    observations = measured(session.rig, "backlash@theta4:width_rad=3e-3", 250, 11, noise_mm=3.0)
    model = identify(session.rig, rig_text("swdt82"), observations, effects="backlash@theta4")
    assert model_warnings(model, observations) == ()
    assert rms(Predictor.of(model).effects_mm(observations) - Predictor.of(model).geometric_mm(observations)) > 1.0
    bare = replace(observations, extra={})
    assert model_warnings(model, bare) == ("backlash@theta4 is left out: this data lacks the column theta4_dir",)
    without = model.chain.positions_mm(model.values, model.chain.bind(bare))
    np.testing.assert_allclose(Predictor.of(model).effects_mm(bare), without, rtol=0.0, atol=1e-9)
    partly = replace(observations, extra={"theta4_dir": np.where(np.arange(250) < 5, np.nan, 1.0)})
    assert model_warnings(model, partly) == (
        "backlash@theta4 is left out in 5 of 250 rows: this data lacks the column theta4_dir",
    )
    assert np.isfinite(Predictor.of(model).predict(partly).sigma_mm).all()


def test_a_refitted_base_keeps_the_effects(stiff: Fitted) -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    elsewhere = replace(
        stiff.held_out,
        position_mm=stiff.held_out.position_mm @ turn.T + [500.0, -300.0, 20.0],
        setup=np.full(len(stiff.held_out), "there"),
    )
    model = with_refitted_base(stiff.model, elsewhere)
    assert model.effects == stiff.model.effects
    before = stiff.held_out.position_mm - Predictor.of(stiff.model).effects_mm(stiff.held_out)
    after = elsewhere.position_mm - Predictor.of(model).effects_mm(elsewhere)
    assert rms(after) < 1.05 * rms(before)
    assert rms(elsewhere.position_mm - Predictor.of(model).geometric_mm(elsewhere)) > 3.0 * rms(after)
    sigma = Predictor.of(model).predict(elsewhere).sigma_mm
    assert np.median(sigma) == pytest.approx(
        float(np.median(Predictor.of(stiff.model).predict(stiff.held_out).sigma_mm)), rel=0.3
    )


def test_coefficients_and_columns_have_one_order(stiff: Fitted) -> None:
    context = EffectContext(stiff.model.chain, stiff.model.values, stiff.training)
    additions = fitted_columns(stiff.model.effects, context)
    assert (
        len(additions)
        == len(coefficient_values(stiff.model.effects))
        == len(stiff.model.covariance) - len(stiff.model.values)
    )
    assert stiff.adopted.solution.additions is not None
    assert additions.names == stiff.adopted.solution.additions.names
    report = stiff.model.effects[0].as_dict()
    assert list(report)[:3] == ["family", "where", "coefficients"]
