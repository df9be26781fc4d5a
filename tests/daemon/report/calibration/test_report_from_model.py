from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.effects.base import FittedCoefficient
from calibration.effects.fitted import FittedEffect
from calibration.evaluation.evaluation import evaluate
from calibration.observations import parse_observations
from daemon.report.calibration.from_model import report_input
from daemon.report.calibration.page import calibration_report
from tests.daemon.support.offline import held_out_csv, small_calibration


def test_report_of_a_model_has_the_figures_of_its_evaluation() -> None:
    model, training = small_calibration()
    held_out = evaluate(model, parse_observations(held_out_csv(), model.rig, "test.csv"))
    report = report_input(training, held_out, made_utc_ns=1_795_000_000_000_000_000, sources={"data": "train.csv"})
    assert report.held_out is not None
    for stage, figures in zip(report.held_out.errors_mm, held_out.stages(), strict=True):
        assert report.held_out.stage(stage).rms_mm == pytest.approx(figures["rms_mm"])
    assert report.residual == "lightgbm"
    assert report.provenance["made"] == "2026-11-18 11:06 UTC"
    assert report.provenance["data"] == "train.csv"
    assert "lightgbm" in report.provenance["versions"]
    assert "On 60 held-out fixes" in calibration_report(report)


def test_positions_are_in_the_base_frame_whatever_the_station() -> None:
    _, training = small_calibration()
    table = report_input(training, None).training
    # The nominal ur10 reaches 1.3 m; the tracker stood 3 m away.
    distance = np.linalg.norm(table.position_mm, axis=1)
    assert distance.max() < 1800.0
    assert np.linalg.norm(training.observations.position_mm, axis=1).min() > 1800.0


def test_corrections_are_in_degrees_and_millimetres_with_their_tolerance() -> None:
    model, training = small_calibration()
    lines = {line.name: line for line in report_input(training, None).parameters}
    alpha = next(p for p in model.parameters if p.name == "row3.alpha")
    assert lines["row3.alpha"].unit == "deg"
    assert lines["row3.alpha"].correction == pytest.approx(np.degrees(alpha.value))
    assert lines["row3.alpha"].tolerance == pytest.approx(model.rig.tolerances.angle_deg)
    assert lines["row2.a"].determined
    assert not any(name.startswith("base") for name in lines)


def test_an_effect_at_no_joint_is_listed_with_how_far_it_moves_the_prism() -> None:
    model, training = small_calibration()
    scale = FittedEffect("station_scale", "station", (FittedCoefficient("ppm", "ppm", 20.0, 5.0, 10.0),))
    (line,) = report_input(replace(training, model=replace(model, effects=(scale,))), None).effects
    range_mm = np.linalg.norm(training.observations.position_mm, axis=1)
    assert line.unit == "mm"
    assert line.change == pytest.approx(20e-6 * range_mm.max(), rel=1e-2)
    assert line.coefficients == [("ppm", 20.0, 5.0, "ppm")]
