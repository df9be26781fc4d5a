"""Rows that lack an input of a fitted effect are not used, because the effect would count as zero there."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from calibration.gap.adoption import Adopted, adopt
from calibration.identification.solve import solve
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import calibrate, identify
from calibration.pipeline.find_gap import find_gap
from calibration.pipeline.known_inputs import fitted_where_known
from calibration.run_settings import Run
from daemon.rig_files import load_rig
from tests.calibration.pipeline.test_calibrate import joined
from tests.calibration.searches import Kept
from tests.daemon.support.gap import session_csv

SOURCE = load_rig("swdt82")
WIDTH_RAD = 4e-3
LACKING = slice(30, 60)  # rows of fifteen poses in a row, of eighty


@functools.cache
def play() -> Observations:
    """A boom with play at theta4, of which the direction is unknown for a while, as after a pause in reading."""
    data = session_csv(80, hidden=f"backlash@theta4:width_rad={WIDTH_RAD}")
    seen = parse_observations(data, SOURCE.rig, "session.csv")
    direction = seen.extra["theta4_dir"].copy()
    direction[LACKING] = np.nan
    return replace(seen, extra={**seen.extra, "theta4_dir": direction})


@pytest.mark.long
def test_play_is_the_only_name_and_has_its_size_where_directions_are_missing_for_a_while() -> None:
    gap = find_gap(SOURCE.rig, SOURCE.text, play(), families=("backlash", "zero_step"))
    assert [str(effect.family) + "@" + effect.where for effect in gap.effects] == ["backlash@theta4"]
    assert gap.effects[0].coefficients[0].value == pytest.approx(WIDTH_RAD, rel=0.05)
    assert len(gap.observations) == len(play()) - 30
    assert [warning for warning in gap.warnings if "theta4_dir" in warning] == [
        "30 of 160 rows are not used, because they lack the column theta4_dir, which backlash@theta4 needs"
    ]


def test_a_calibration_learns_and_tells_its_error_without_rows_that_lack_an_input() -> None:
    model, evaluation = calibrate(SOURCE.rig, SOURCE.text, play(), effects="backlash@theta4", residual="rbfn")
    assert len(evaluation.observations) == len(model.fitted_rows) == len(play()) - 30
    (effect,) = model.effects
    assert effect.coefficients[0].value == pytest.approx(WIDTH_RAD, rel=0.05)


def test_a_set_up_most_of_whose_rows_lack_an_input_is_kept_whole() -> None:
    first, second = (
        session_csv(poses, seed, setup, f"backlash@theta4:width_rad={WIDTH_RAD}").decode()
        for poses, seed, setup in ((30, 5, "S1"), (40, 6, "S2"))
    )
    seen = parse_observations((first + second.split("\n", 1)[1]).encode(), SOURCE.rig, "session.csv")
    direction = np.where(seen.setup == "S1", np.nan, seen.extra["theta4_dir"])
    direction[-2:] = np.nan
    rows = replace(seen, extra={**seen.extra, "theta4_dir": direction})
    model = identify(SOURCE.rig, SOURCE.text, rows, effects="backlash@theta4")
    assert set(model.placements) == {"S1", "S2"}
    assert len(model.fitted_rows) == 60 + 80 - 2
    assert any(warning.startswith("backlash@theta4 counts as zero in 60 of 138 rows") for warning in model.warnings)


def test_a_set_up_of_a_few_rows_is_kept_whole_and_keeps_no_rows_of_others() -> None:
    second = session_csv(2, 6, "S2", f"backlash@theta4:width_rad={WIDTH_RAD}")
    few = parse_observations(second, SOURCE.rig, "session.csv")
    rows = joined(play(), replace(few, extra=few.extra | {"theta4_dir": np.array([np.nan, np.nan, 1.0, 1.0])}))
    model = identify(SOURCE.rig, SOURCE.text, rows, effects="backlash@theta4")
    assert len(model.fitted_rows) == len(play()) - 30 + 4
    (effect,) = model.effects
    assert effect.coefficients[0].value == pytest.approx(WIDTH_RAD, rel=0.05)


@pytest.mark.parametrize("others", ["none", "backlash@theta1"])
def test_no_row_is_left_out_for_an_effect_that_the_others_do_not_show(others: str) -> None:
    def fit(rows: Observations, run: Run) -> Adopted:
        effects = "backlash@theta4" if len(rows) == len(play()) else others
        with run.workers() as pool:
            solution = solve(SOURCE.rig, rows, prior="recalibration", run=replace(run, executor=pool))
        return adopt(solution, rows, effects)

    found, rows, taken = fitted_where_known(play(), Run(), fit, lambda found: found)
    assert len(rows) == len(play())
    assert [effect.where for effect in found.effects] == ["theta4"]
    assert any("counts as zero in 30 of 160 rows" in warning for warning in taken.warnings)


def test_an_effect_that_the_other_rows_cannot_show_is_fitted_in_all_rows() -> None:
    payload = np.zeros(len(play()))
    payload[LACKING] = 200.0
    rows = replace(play(), extra=play().extra | {"payload_kg": payload})
    model = identify(SOURCE.rig, SOURCE.text, rows, effects="backlash@theta4,payload_change@theta4")
    assert len(model.fitted_rows) == len(rows)
    assert len(model.effects) == 2


def test_all_rows_are_used_if_too_few_would_be_left() -> None:
    few = play().select(np.arange(14, 44))
    model = identify(SOURCE.rig, SOURCE.text, few, effects="backlash@theta4")
    assert len(model.fitted_rows) == len(few) == 30
    assert any(warning.startswith("backlash@theta4 counts as zero in 14 of 30 rows") for warning in model.warnings)


def test_a_search_that_is_repeated_without_rows_tells_of_no_other_search_and_can_be_resumed() -> None:
    checkpoint = Kept()
    model = identify(SOURCE.rig, SOURCE.text, play(), effects="backlash@theta4", run=Run(checkpoint=checkpoint))
    assert not any("checkpoint" in warning for warning in model.warnings)
    again = identify(SOURCE.rig, SOURCE.text, play(), effects="backlash@theta4", run=Run(checkpoint=checkpoint))
    assert not any("checkpoint" in warning for warning in again.warnings)
    np.testing.assert_array_equal(again.values, model.values)
