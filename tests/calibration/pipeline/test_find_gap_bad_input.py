"""The gap workflow on data and models that nobody should give it: a sentence, never a wrong number."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.errors import CalibrationError, DataError, ModelError, UnsafeError
from calibration.model.files import MANIFEST, model_from_files, model_to_files
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.warnings import model_warnings
from calibration.observations import Observations, parse_observations
from calibration.pipeline.find_gap import find_gap
from calibration.run_settings import Run
from tests.daemon.support import gap as support


def session(poses: int, seed: int = 5, hidden: str = support.HIDDEN) -> Observations:
    return parse_observations(support.session_csv(poses, seed, hidden=hidden), support.SOURCE.rig, "session.csv")


def with_effect(family: str, where: str, coefficient: FittedCoefficient, **settings: float) -> CalibratedModel:
    """The model of a boom with another effect than it was fitted with, for what is said of it."""
    return replace(support.named().model, effects=(FittedEffect(family, where, (coefficient,), settings),))


def test_what_is_doubtful_of_the_training_and_of_the_held_out_rows_is_told() -> None:
    observations = session(20)
    twice = observations.select(np.concatenate([np.arange(len(observations)), np.arange(10)]))
    held_out = replace(session(10, 77), extra={})
    warnings = find_gap(support.SOURCE.rig, support.SOURCE.text, twice, holdout=held_out).warnings
    assert any("10 of 50 rows are exact copies of earlier rows" in warning for warning in warnings)
    left_out = "in the held-out rows: backlash@theta4 is left out: this data lacks the column theta4_dir"
    assert left_out in warnings


@pytest.mark.long
def test_an_effect_of_the_library_that_is_too_weak_to_be_named_is_not_said_to_be_outside_of_it() -> None:
    observations = session(60, hidden="base_settlement@base:tilt_x_rad_per_h=6e-4")
    gap = find_gap(support.SOURCE.rig, support.SOURCE.text, observations)
    assert gap.verdict != "none"
    assert "not in the library" not in (gap.description or "")
    if gap.verdict == "unidentified":
        assert "base_settlement@base would explain this, but" in (gap.description or "")


def test_a_load_beyond_those_of_the_training_is_doubtful_for_every_effect_that_goes_with_it() -> None:
    droop = with_effect("boom_droop", "boom", FittedCoefficient("flexibility_per_Nm2", "1/(N m^2)", 1e-8, 1e-9, 1e-8))
    trained = replace(droop, coverage=replace(droop.coverage, payload=(0.0, 100.0)))
    rows = support.named().observations
    heavy = replace(rows, extra={**rows.extra, "payload_kg": np.full(len(rows), 900.0)})
    assert any("outside the 0 .. 100 kg of the training data" in warning for warning in model_warnings(trained, heavy))
    friction = with_effect("load_hysteresis", "theta4", FittedCoefficient("rad_per_Nm", "rad/(N m)", 1e-8, 1e-9, 1e-8))
    measured = replace(friction, coverage=replace(friction.coverage, torques=("theta4",)))
    assert any("the torque of theta4 was measured in training" in warning for warning in model_warnings(measured, rows))


def test_rates_and_torques_that_no_machine_has_neither_name_anything_nor_end_the_work() -> None:
    rows, rng = session(20), np.random.default_rng(3)
    unmeasured = {name: values for name, values in rows.extra.items() if not name.endswith("_dir")}
    wild = {"theta4_rate": rng.uniform(-9e4, 9e4, len(rows)), "temperature_degC": rng.uniform(-100, 500, len(rows))}
    wild |= {"theta4_Nm": 1e-300 * rng.normal(size=len(rows)), "payload_kg": rng.uniform(0, 1e5, len(rows))}
    massless = support.SOURCE.rig.model_copy(update={"masses": ()})
    gap = find_gap(massless, support.SOURCE.text, replace(rows, extra={**unmeasured, **wild}))
    assert gap.verdict == "none"
    assert any("too large ones make a loose fit" in warning for warning in gap.warnings)
    assert gap.disabled["joint_compliance"] == "it has no effect in these poses"


def test_time_does_not_run_backwards_while_a_machine_stands() -> None:
    header, first, *rows = support.session_csv(20).decode().splitlines()
    column = header.split(",").index("dwell_s")
    cells = first.split(",")
    cells[column] = "-5.0"
    with pytest.raises(DataError, match="line 2, column dwell_s: -5 is outside the possible range"):
        parse_observations("\n".join([header, ",".join(cells), *rows]).encode(), support.SOURCE.rig, "session.csv")


def test_a_model_whose_effect_has_no_plausible_size_is_not_read() -> None:
    files = model_to_files(support.named().model)
    document = json.loads(files["model.json"])
    document["effects"][0]["coefficients"][0]["prior_sigma"] = 1e-300
    edited = json.dumps(document).encode()
    manifest = json.loads(files[MANIFEST])
    manifest["files"]["model.json"] = {"sha256": hashlib.sha256(edited).hexdigest(), "bytes": len(edited)}
    with pytest.raises(ModelError, match="prior_sigma"):
        model_from_files({**files, "model.json": edited, MANIFEST: json.dumps(manifest).encode()})


def test_held_out_rows_of_another_setup_are_refused_before_any_work_in_words_that_help() -> None:
    observations = support.named().observations
    elsewhere = replace(observations, setup=np.full(len(observations), "S2"))
    said: list[str] = []
    with pytest.raises(
        UnsafeError, match=r"set-up 'S2' of the held-out rows is not among .*'S1'.*hold out rows of these set-ups"
    ):
        find_gap(
            support.SOURCE.rig,
            support.SOURCE.text,
            observations,
            holdout=elsewhere,
            run=Run(progress=lambda share, what: said.append(what)),
        )
    assert not said


def test_a_coefficient_beyond_all_machines_is_refused_where_the_uncertainty_would_drown_the_noise() -> None:
    model = support.named().model
    (effect,) = model.effects
    (width,) = effect.coefficients
    absurd = replace(model, effects=(replace(effect, coefficients=(replace(width, value=9e8),)),))
    unmeasured = replace(support.named().observations, extra={})
    with pytest.raises(CalibrationError, match="so large that rounding hides its noise"):
        Predictor.of(absurd).deviations(unmeasured)


SPAN = {"from_s": 0.0, "span_s": 3600.0}
STEP = {"time_s": 60.0, "time_error_s": 1.0, "span_s": 3600.0}


@pytest.mark.parametrize(
    ("family", "settings", "wrong", "words"),
    [
        ("base_settlement", {**SPAN, "size1_mm": 1.0, "size2_mm": 1.0, "size3_mm": 1.0}, "span_s", "span_s"),
        ("clock_drift", {**SPAN, "size1_mm": 1.0}, "span_s", "span_s"),
        ("base_step", {**STEP, "size1_mm": 1.0, "size2_mm": 1.0, "size3_mm": 1.0}, "time_error_s", "time_error_s"),
        ("transducer_index_jump", STEP, "span_s", "span_s"),
    ],
)
def test_settings_that_no_training_leaves_are_not_read(
    family: str, settings: dict[str, float], wrong: str, words: str
) -> None:
    assert library()[family].names(settings)
    with pytest.raises(ValueError, match=words):
        library()[family].names({**settings, wrong: -1.0})
