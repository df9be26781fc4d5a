"""What a model of two set-ups with a backlash knows where less is given, and what is planned with it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration.design.accuracy import expected_accuracy
from calibration.design.knowledge import Knowledge, setup_of
from calibration.design.planning import plan_poses
from calibration.errors import UnsafeError
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text
from tests.simulated.observations import simulate_observations

RIG = shipped_rig("ys100")
EFFECT = "backlash@theta2"
TRUTH = RigTruth(RIG, 3, effects=parse_effects(f"{EFFECT}:width_rad=4e-3"))


def measured(fixes: dict[str, int], seed: int) -> Observations:
    """Fixes at set-ups."""
    tables = [simulate_observations(TRUTH, n, seed, setup=name).csv_text() for name, n in fixes.items()]
    rows = tables[0] + "".join(table.split("\n", 1)[1] for table in tables[1:])
    return parse_observations(rows.encode(), RIG, "simulated.csv")


@pytest.fixture(scope="module")
def model() -> CalibratedModel:
    return identify(RIG, rig_text("ys100"), measured({"A": 20, "B": 100}, 0), effects=EFFECT)


def without_directions(observations: Observations) -> Observations:
    return replace(observations, extra={k: v for k, v in observations.extra.items() if not k.endswith("_dir")})


def test_without_the_direction_a_prediction_is_less_certain_by_half_the_play(model: CalibratedModel) -> None:
    held_out = measured({"B": 300}, 1)
    blind = without_directions(held_out)
    told, untold = Predictor.of(model).predict(held_out), Predictor.of(model).predict(blind)
    half_deg = math.degrees(0.5 * model.effects[0].coefficients[0].value)
    at = Predictor.of(model).linearise(blind).joint_jacobian[:, :, RIG.joint_names.index("theta2")] * half_deg
    grown = untold.sigma_mm**2 - told.sigma_mm**2
    assert np.median(grown / at**2) == pytest.approx(1.0, abs=0.1)
    deviation = (held_out.position_mm - untold.position_mm) / untold.sigma_mm
    assert 0.8 < np.sqrt(np.mean(deviation**2)) < 1.2


def test_poses_without_a_direction_are_expected_to_err_by_half_the_play(model: CalibratedModel) -> None:
    found = expected_accuracy(model, np.random.default_rng(0), poses=300)
    lin = Knowledge.of_model(model, 1).linearise(found.readings)
    held = dict(zip(RIG.joint_names, found.readings.T, strict=True))
    side = np.random.default_rng(1).choice([-1.0, 1.0], len(found.readings))
    came_from = {"theta2_dir": side}
    true_mm = TRUTH.prism_mm("tool", held, came_from, setup="B")
    actual_mm = np.linalg.norm(lin.position_mm - true_mm, axis=1)
    assert found.rms_mm == pytest.approx(np.sqrt(np.mean(actual_mm**2)), rel=0.2)
    assert np.mean(actual_mm < found.spread.p95_mm) > 0.9


def test_accuracy_and_plan_are_of_the_same_setup(model: CalibratedModel) -> None:
    assert expected_accuracy(model, np.random.default_rng(0), poses=50).setup == "B"
    planned = plan_poses(RIG, 8, model=model)
    assert planned.before is not None
    assert (planned.before.setup, planned.after.setup) == ("B", "B")
    assert "as in set-up 'B' of the model" in planned.station
    other = plan_poses(RIG, 8, model=model, setup="A")
    assert other.after.setup == "A"
    assert "as in set-up 'A' of the model" in other.station
    with pytest.raises(UnsafeError, match=r"set-up 'C' is unknown to the model \(known: 'A', 'B'\)"):
        setup_of(model, "C")


def test_only_what_the_setup_can_show_counts_among_the_parameters(model: CalibratedModel) -> None:
    planned = plan_poses(RIG, 15, model=model).plan
    assert (planned.parameters, planned.determined) == (32, 27)
    assert list(planned.poses.conditions) == ["theta2_dir"]


def test_an_effect_that_the_model_has_is_told_apart_as_if_it_were_new(model: CalibratedModel) -> None:
    pair = (EFFECT, "encoder_harmonic@theta2")
    with_it = plan_poses(RIG, 10, model=model, separate=pair)
    assert with_it.before is not None
    assert with_it.plan.stands_out[EFFECT] > 5.0
    assert with_it.after.parameters_mm < with_it.before.parameters_mm
    bare = replace(model, effects=(), covariance=model.covariance[: len(model.values), : len(model.values)])
    new = plan_poses(RIG, 10, model=bare, separate=pair)
    assert with_it.plan.stands_out[EFFECT] == pytest.approx(new.plan.stands_out[EFFECT], rel=0.01)


def test_a_rig_file_that_was_edited_since_is_refused(model: CalibratedModel) -> None:
    joints = (RIG.joints[0].model_copy(update={"limits": (-10.0, 10.0)}), *RIG.joints[1:])
    with pytest.raises(UnsafeError, match="differs from the rig that the model was calibrated with, in joints"):
        plan_poses(RIG.model_copy(update={"joints": joints}), 5, model=model)
