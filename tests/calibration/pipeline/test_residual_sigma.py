"""With a learned residual, predicted sigma is still the size of the errors on rows that nothing was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calibration.evaluation.evaluation import evaluate
from calibration.model.files import model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.pipeline.calibrate import identify, train_residual
from calibration.rig.description import shipped_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import rig_text, rms, simulated

pytestmark = pytest.mark.long

EFFECTS = (
    "encoder_harmonic@theta1:k=2:cosk_rad=4e-3:sink_rad=3e-3,encoder_harmonic@theta4:k=2:cosk_rad=3e-3:sink_rad=3e-3",
    "backlash@theta1:width_rad=4e-3,backlash@theta4:width_rad=3e-3,"
    "boom_droop@boom,joint_compliance@theta4:compliance_rad_per_Nm=2e-8",
)


@dataclass(frozen=True)
class Outcome:
    model: CalibratedModel
    geometric_mm: float
    hybrid_mm: float
    chi_square: float


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    rig = shipped_rig("swdt82")
    found = []
    for seed, effects in enumerate(EFFECTS, 22):
        truth = RigTruth(rig, seed, effects=parse_effects(effects))
        training, held_out = simulated(truth, 250, seed), simulated(truth, 600, seed + 100)
        model = train_residual(identify(rig, rig_text("swdt82"), training, effects="none"), training)
        evaluation = evaluate(model, held_out)
        deviation = evaluation.errors_mm["hybrid"] / evaluation.sigma_mm
        geometric, hybrid = (rms(evaluation.errors_mm[stage]) for stage in ("geometric", "hybrid"))
        found.append(Outcome(model, geometric, hybrid, float((deviation**2).mean())))
    return found


def test_hidden_effects_are_learned(outcomes: list[Outcome]) -> None:
    assert all(o.model.residual is not None for o in outcomes)
    assert all(o.hybrid_mm < 0.75 * o.geometric_mm for o in outcomes)
    assert np.mean([o.hybrid_mm / o.geometric_mm for o in outcomes]) < 0.6


def test_predicted_sigma_is_the_size_of_held_out_errors(outcomes: list[Outcome]) -> None:
    assert 0.85 < np.mean([o.chi_square for o in outcomes]) < 1.15
    assert all(0.8 < o.chi_square < 1.25 for o in outcomes)


def test_noise_with_a_residual_is_the_size_of_held_out_errors(outcomes: list[Outcome]) -> None:
    assert all(o.model.noise_mm == pytest.approx(o.hybrid_mm, rel=0.2) for o in outcomes)


def test_a_stored_model_predicts_the_same_sigma(outcomes: list[Outcome]) -> None:
    model = outcomes[0].model
    observations = simulated(RigTruth(model.rig, 21), 40, 9)
    again = Predictor.of(model_from_files(model_to_files(model))).predict(observations)
    np.testing.assert_array_equal(again.sigma_mm, Predictor.of(model).predict(observations).sigma_mm)
    np.testing.assert_array_equal(again.position_mm, Predictor.of(model).predict(observations).position_mm)
