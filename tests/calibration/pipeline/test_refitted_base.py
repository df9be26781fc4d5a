"""A base that is fitted anew for a model with a learned residual: beside the residual, and as sure as it says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.errors import ModelError
from calibration.evaluation.evaluation import evaluate
from calibration.experiments.residual_comparison import MethodResult, compare_residuals
from calibration.model.files import model_from_files, model_to_files
from calibration.model.intervals import SetupErrors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.observations import Observations
from calibration.pipeline.calibrate import identify, rows_to_learn_from, train_residual
from calibration.residual.baselines import CorrectionTable
from calibration.rig.description import shipped_rig
from calibration.run_settings import Run
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms, simulated

_FEW = 8  # fixes at the new set-up


@dataclass(frozen=True)
class Moved:
    """A machine that plays and droops, learned at one set-up, then measured at another."""

    model: CalibratedModel
    training: Observations
    few: tuple[Observations, ...]
    many: Observations
    held_out: Observations


@pytest.fixture(scope="module")
def moved() -> Moved:
    effects = "backlash@theta1:width_rad=4e-3,backlash@theta4:width_rad=3e-3,boom_droop@boom"
    truth = RigTruth(shipped_rig("swdt82"), 23, effects=parse_effects(effects))
    training, there = simulated(truth, 150, 23), simulated(truth, 700, 24, setup="there")
    model = train_residual(identify(truth.rig, rig_text("swdt82"), training, effects="none"), training, kind="rbfn")
    assert model.residual is not None
    order = [np.random.default_rng(seed).permutation(300)[:_FEW] for seed in range(10)]
    return Moved(
        model,
        training,
        tuple(there.select(rows) for rows in order),
        there.select(np.arange(300)),
        there.select(np.arange(300, 700)),
    )


@pytest.fixture(scope="module")
def refitted(moved: Moved) -> list[CalibratedModel]:
    return [with_refitted_base(moved.model, few) for few in moved.few]


def test_a_base_refitted_on_few_fixes_keeps_what_the_residual_gains(
    moved: Moved, refitted: list[CalibratedModel]
) -> None:
    best = _error_mm(with_refitted_base(moved.model, moved.many), moved.held_out)
    errors = [_error_mm(model, moved.held_out) for model in refitted]
    # Six parameters from 24 coordinates: a quarter of their noise, and what the lever arms make of it.
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * best


def test_a_prediction_at_a_refitted_set_up_is_as_sure_as_it_says(moved: Moved, refitted: list[CalibratedModel]) -> None:
    covered, chi_square = [], []
    for model in refitted:
        prediction = Predictor.of(model).predict(moved.held_out)
        error = moved.held_out.position_mm - prediction.position_mm
        covered.append(prediction.coverage(error).radius)
        chi_square.append(((error / prediction.formal_mm) ** 2).mean())
    assert np.mean(covered) == pytest.approx(0.9, abs=0.04)
    assert 0.8 < np.mean(chi_square) < 1.25


def test_what_a_machine_does_at_another_site_alone_widens_its_intervals_there() -> None:
    rig = shipped_rig("swdt82")
    model = identify(rig, rig_text("swdt82"), simulated(RigTruth(rig, 23), 150, 23), effects="none")
    soft = parse_effects("base_compliance@base:x_rad_per_Nm=6e-8:y_rad_per_Nm=4e-8")  # the ground there
    there = simulated(RigTruth(rig, 23, effects=soft), 500, 24, setup="there")
    few, others = there.select(np.arange(40)), there.select(np.arange(40, 500))
    placed = with_refitted_base(model, few)
    as_at_home = Predictor.of(placed).predict(others)
    counted_there = Predictor.of(replace(placed, intervals=SetupErrors.of(placed, few).intervals)).predict(others)
    error = others.position_mm - as_at_home.position_mm
    assert as_at_home.coverage(error).radius < 0.75
    assert counted_there.coverage(error).radius == pytest.approx(0.9, abs=0.06)
    assert np.mean(np.abs(error) <= 1.645 * counted_there.sigma_mm) == pytest.approx(0.9, abs=0.06)
    # Counted on the half of the fixes that does not tell how wide they are.
    assert evaluate(model, there, refit_base=True).coverage.radius == pytest.approx(0.9, abs=0.04)


def test_the_stages_without_a_residual_have_a_base_of_their_own(moved: Moved) -> None:
    few = moved.few[0]
    plain = evaluate(replace(moved.model, residual=None), few, refit_base=True)
    found = evaluate(moved.model, few, refit_base=True)
    for stage in ("nominal", "geometric", "effects"):
        np.testing.assert_array_equal(found.errors_mm[stage], plain.errors_mm[stage])
    np.testing.assert_array_equal(found.errors_mm["geometric"], found.errors_mm["effects"])
    assert found.outliers == plain.outliers


def test_a_residual_that_reaches_few_fixes_of_a_site_is_left_out_there(moved: Moved) -> None:
    residual = moved.model.residual
    assert residual is not None
    region = residual.region
    near = moved.many.select(np.arange(100))
    # Trained on a part of theta1's range alone: what was learned there says nothing of the other rows.
    narrow = region.joints.copy()
    narrow[:2, 0] = np.quantile(near.joints["theta1"], 0.1), 1.0
    narrow[2, 0] = 0.5
    home = replace(moved.model, residual=replace(residual, region=replace(region, joints=narrow)))
    found = evaluate(home, near, refit_base=True)
    np.testing.assert_array_equal(found.errors_mm["hybrid"], found.errors_mm["effects"])
    assert found.model.residual is None
    assert any("the residual is left out here, in all rows" in warning for warning in found.warnings)


def test_a_model_with_a_refitted_base_is_stored_whole(moved: Moved, refitted: list[CalibratedModel]) -> None:
    again, prediction = model_from_files(model_to_files(refitted[0])), Predictor.of(refitted[0]).predict(moved.held_out)
    np.testing.assert_array_equal(Predictor.of(again).predict(moved.held_out).sigma_mm, prediction.sigma_mm)
    np.testing.assert_array_equal(Predictor.of(again).predict(moved.held_out).position_mm, prediction.position_mm)
    plain = Predictor.of(replace(refitted[0], base_covariance=None)).predict(moved.held_out)
    assert rms(plain.sigma_mm) < 0.97 * rms(prediction.sigma_mm)
    with pytest.raises(ModelError, match="does not match the set-ups"):
        model_from_files(model_to_files(replace(refitted[0], base_covariance=np.eye(5))))


@pytest.mark.long
def test_compared_residuals_have_each_its_own_base(moved: Moved) -> None:
    few = moved.few[0]
    effects, rbfn = _compared(moved, few, "effects", "rbfn")
    found = evaluate(moved.model, few, refit_base=True)
    assert effects.error_mm == pytest.approx(np.linalg.norm(found.errors_mm["effects"], axis=1))
    assert rbfn.error_mm == pytest.approx(np.linalg.norm(found.errors_mm["hybrid"], axis=1))


def test_a_compared_table_has_its_own_base(moved: Moved) -> None:
    bare = replace(moved.model, residual=None)
    good = moved.training.select(rows_to_learn_from(bare, moved.training))
    learned_mm = Predictor.of(bare).to_base(good, good.position_mm - Predictor.of(bare).effects_mm(good))
    with_its_own, with_that_of_effects = [], []
    for few in moved.few:
        judged = with_refitted_base(bare, few)
        for prism in np.unique(few.prism):
            mine, rows = good.prism == prism, few.select(few.prism == prism)
            table = CorrectionTable.fit(Predictor.of(bare).features(good.select(mine), ()), learned_mm[mine])
            estimate = Predictor.of(judged).to_station(rows, table.predict(Predictor.of(judged).features(rows, ())))
            with_that_of_effects.append(rows.position_mm - Predictor.of(judged).effects_mm(rows) - estimate)
        (compared,) = _compared(moved, few, "table")
        assert compared.error_mm is not None
        with_its_own.append(compared.error_mm[:, None])
    assert rms(np.concatenate(with_its_own)) < 0.97 * rms(np.concatenate(with_that_of_effects))


def _compared(moved: Moved, held_out: Observations, *kinds: str) -> list[MethodResult]:
    return compare_residuals(
        moved.model,
        moved.training,
        held_out,
        kinds,
        refit_base=True,
        clock=lambda: 0.0,
        run=Run(0),
    )


def _error_mm(model: CalibratedModel, rows: Observations) -> float:
    return rms(rows.position_mm - Predictor.of(model).predict(rows).position_mm)
