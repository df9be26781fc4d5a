"""Measured torques: used with either sign, and missed where they were used in training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.effects.context import EffectContext
from calibration.errors import CalibrationError
from calibration.evaluation.evaluation import evaluate
from calibration.kinematics.chain import Chain, Placement
from calibration.kinematics.torques import gravity_torques
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings, times_computed
from calibration.observations import Floats, Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms
from tests.simulated.observations import simulate_observations

EFFECTS = "joint_compliance@theta2:compliance_rad_per_Nm=4e-7,joint_compliance@theta3:compliance_rad_per_Nm=6e-7"


def weighed(rows: Observations, payload: Floats | None) -> Observations:
    """With these payloads in place of the rows' own, and without measured torques."""
    extra = {name: values for name, values in rows.extra.items() if not name.endswith("_Nm") and name != "payload_kg"}
    return replace(rows, extra=extra if payload is None else {**extra, "payload_kg": payload})


def fixes(rig: Rig, truth: RigTruth, poses: int, seed: int, sign: float) -> Observations:
    data = simulate_observations(truth, poses, seed, noise_mm=0.03)
    observations = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    torques = sign * gravity_torques(Chain(rig, {}), np.zeros(len(Chain(rig, {}))), observations)
    columns = {f"{name}_Nm": torques[:, i] for i, name in enumerate(rig.joint_names)}
    return replace(observations, extra=dict(observations.extra) | columns)


@pytest.mark.long
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torques_that_hold_the_load_serve_as_well_as_the_load(sign: float) -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    training, held_out = fixes(rig, truth, 60, 5, sign), fixes(rig, truth, 100, 6, sign)
    model = identify(rig, rig_text("ys100"), training)
    assert {"theta2", "theta3"} <= {effect.where for effect in model.effects}
    assert rms(evaluate(model, held_out).errors_mm["effects"]) < 0.1
    assert any("holds the load" in warning for warning in model.warnings) == (sign < 0.0)


@pytest.mark.long
def test_a_torque_that_was_measured_in_training_is_missed() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    with_torques = fixes(rig, truth, 60, 5, 1.0)
    without = replace(with_torques, extra={k: v for k, v in with_torques.extra.items() if not k.endswith("_Nm")})
    measured, computed = (identify(rig, rig_text("ys100"), data) for data in (with_torques, without))
    assert any("theta2_Nm), which this data lacks" in warning for warning in model_warnings(measured, without))
    assert any("theta2_Nm): leave the column out" in warning for warning in model_warnings(computed, with_torques))
    assert not any(
        "torque" in warning for warning in (*model_warnings(measured, with_torques), *model_warnings(computed, without))
    )
    massless = replace(measured, rig=rig.model_copy(update={"masses": ()}))
    assert sum("theta2_Nm" in warning for warning in model_warnings(massless, without)) == 1


def of_load(model: CalibratedModel, rows: Observations) -> list[str]:
    return [warning for warning in model_warnings(model, rows) if "N m" in warning or "_Nm" in warning]


def test_torques_of_another_unit_are_named_in_training_and_after() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    in_kilo = fixes(rig, truth, 60, 5, 1e-3)
    model = identify(rig, rig_text("ys100"), in_kilo, effects="none")
    assert sum("as if in kN m or of another shaft: theta2_Nm (0.00099 times)" in w for w in model.warnings) == 1
    trained = identify(
        rig, rig_text("ys100"), fixes(rig, truth, 60, 5, 1.0), effects="joint_compliance@theta2,joint_compliance@theta3"
    )
    assert not any("another shaft" in w for w in trained.warnings)
    assert of_load(trained, fixes(rig, truth, 40, 6, 1.0)) == []
    (said,) = of_load(trained, in_kilo)
    assert "as if in kN m" in said


def test_a_joint_that_hardly_carries_anything_in_these_rows_is_compared_with_nothing() -> None:
    """With a straight wrist the forearm's roll carries next to nothing, and its sensor shows friction."""
    rig, rng = shipped_rig("ys100"), np.random.default_rng(0)
    chain, rows, blank = Chain(rig, {"": Placement.identity()}), 60, np.full(60, "")
    joints = {joint.name: 0.5 * rng.uniform(*joint.limits, rows) for joint in rig.joints}
    joints |= {name: rng.normal(0.0, 0.01, rows) for name in ("theta4", "theta5", "theta6")}
    still = Observations(np.full(rows, rig.prism_names[0]), joints, *np.zeros((2, rows, 3)), blank, blank, blank)
    context = EffectContext(chain, np.zeros(len(chain)), still)
    measured = {f"{name}_Nm": 1e3 * context.torque(name) for name in ("theta2", "theta4")}
    compared = times_computed(replace(context, observations=replace(still, extra=measured)))
    assert set(compared) == {"theta2"}
    assert compared["theta2"] == pytest.approx(1e3)


def test_torques_whose_sign_has_changed_since_training_are_named() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    for sign in (1.0, -1.0):
        model = identify(rig, rig_text("ys100"), fixes(rig, truth, 60, 5, sign), effects="joint_compliance@theta2")
        assert of_load(model, fixes(rig, truth, 40, 6, sign)) == []
        changed = of_load(model, fixes(rig, truth, 40, 6, -sign))
        assert changed[0].startswith("theta2_Nm has the opposite sign to training")


def test_loads_that_training_did_not_have_are_named() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    everywhere, elsewhere = (weighed(fixes(rig, truth, 200, seed, 1.0), None) for seed in (5, 6))
    raised = everywhere.select(everywhere.joints["theta2"] > 80.0)
    effects = "joint_compliance@theta2,joint_compliance@theta3"
    model, whole = (identify(rig, rig_text("ys100"), rows, effects=effects) for rows in (raised, everywhere))
    assert of_load(whole, elsewhere) == []
    warnings = of_load(model, elsewhere)
    assert warnings[0].startswith(
        "the load on theta2 is outside the -3455 .. 1803 N m of the training data in 29 of 200"
    )
    assert of_load(model_from_files(model_to_files(model)), elsewhere) == warnings


def test_an_effect_that_a_load_could_make_is_doubted_where_no_load_is_known() -> None:
    rig = shipped_rig("ys100")
    massless = rig.model_copy(update={"masses": ()})
    measured = fixes(rig, RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS)), 60, 5, 1.0)

    def doubted(rig: Rig, rows: Observations) -> bool:
        model = identify(rig, rig_text("ys100"), rows, effects="angle_scale@theta2")
        return any("angle_scale@theta2 may be a deflection under load" in warning for warning in model.warnings)

    assert doubted(massless, weighed(measured, None))
    assert not doubted(massless, measured)
    assert not doubted(rig, weighed(measured, None))


@pytest.mark.long
def test_coefficients_of_effects_count_among_what_the_data_must_determine() -> None:
    rig = shipped_rig("ys100")
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    training = fixes(rig, truth, 60, 5, 1.0)
    plain, full = (identify(rig, rig_text("ys100"), training, effects=effects) for effects in ("none", "auto"))
    coefficients = sum(len(effect.coefficients) for effect in full.effects)
    assert coefficients > 0
    assert full.identifiability.parameters == plain.identifiability.parameters + coefficients


@pytest.fixture(scope="module")
def carrying() -> CalibratedModel:
    """A model of an arm that carried 0 to 110 kg in training."""
    rig = shipped_rig("ys100")
    payload = np.random.default_rng(7).uniform(0.0, 110.0, 60)
    payload[:2] = 0.0, 110.0
    truth = RigTruth(rig, 5, perturbation=0.6, effects=parse_effects(EFFECTS))
    data = simulate_observations(truth, 60, 5, noise_mm=0.03, columns={"payload_kg": payload})
    rows = parse_observations(data.csv_text().encode(), rig, "simulated.csv")
    return identify(rig, rig_text("ys100"), rows, effects="joint_compliance@theta2,joint_compliance@theta3")


def of_payload(model: CalibratedModel, rows: Observations) -> list[str]:
    return [warning for warning in model_warnings(model, rows) if "payload" in warning]


def test_a_payload_that_training_did_not_have_is_named(carrying: CalibratedModel) -> None:
    rig = carrying.rig
    rows = fixes(rig, RigTruth(rig, 5), 40, 8, 1.0)
    inside, heavy, gappy = (np.full(40, kg) for kg in (60.0, 60.0, 60.0))
    heavy[:7], gappy[:5] = 400.0, np.nan
    assert carrying.coverage.payload == (0.0, 110.0)
    assert of_payload(carrying, weighed(rows, inside)) == []
    assert of_payload(carrying, weighed(rows, heavy)) == [
        "payload_kg: 7 of 40 rows are outside the 0 .. 110 kg of the training data; the loads that effects and "
        "residual use are beyond those in training"
    ]
    missing = "payload_kg is missing in {} of 40 rows: the rig file's payload is used there"
    assert of_payload(carrying, weighed(rows, gappy)) == [missing.format(5)]
    assert of_payload(carrying, weighed(rows, None)) == [missing.format(40)]
    again = model_from_files(model_to_files(carrying))
    assert model_warnings(again, weighed(rows, heavy)) == model_warnings(carrying, weighed(rows, heavy))


def test_a_payload_says_nothing_where_no_load_is_computed_from_it(carrying: CalibratedModel) -> None:
    rig = carrying.rig
    measured = fixes(rig, RigTruth(rig, 5), 40, 8, 1.0)
    assert of_payload(carrying, measured) == []  # it is in the torques
    heavy = weighed(measured, np.full(40, 400.0))
    assert of_payload(replace(carrying, effects=(), covariance=carrying.covariance[:-2, :-2]), heavy) == []


def test_a_payload_where_training_had_the_rig_files_own_is_named(carrying: CalibratedModel) -> None:
    rig = carrying.rig
    rows = fixes(rig, RigTruth(rig, 5), 40, 8, 1.0)
    plain = replace(carrying, coverage=replace(carrying.coverage, payload=None))
    assert of_payload(plain, weighed(rows, None)) == []
    assert of_payload(plain, weighed(rows, np.full(40, 110.0))) == []
    (said,) = of_payload(plain, weighed(rows, np.full(40, 20.0)))
    assert said.startswith("payload_kg: 40 of 40 rows are outside the 110 .. 110 kg of the training data")


def test_a_prediction_that_is_not_finite_is_refused(carrying: CalibratedModel) -> None:
    rig = carrying.rig
    rows = fixes(rig, RigTruth(rig, 5), 40, 8, 1.0)
    strange = np.arange(40) == 17
    endless = replace(rows, extra={**rows.extra, "theta2_rate": np.where(strange, 1e200, 0.0)})
    with np.errstate(over="ignore", invalid="ignore"), pytest.raises(CalibrationError, match="prediction of line 19 "):
        Predictor.of(carrying).predict(endless)
    heavy = replace(rows, extra={**rows.extra, "theta2_Nm": np.where(strange, 1.7e308, 0.0)})
    for use in (Predictor.of(carrying).predict, Predictor.of(carrying).effects_mm, Predictor.of(carrying).parts):
        with np.errstate(all="ignore"), pytest.raises(CalibrationError, match="prediction of line 19 "):
            use(heavy)
