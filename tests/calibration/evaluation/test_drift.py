"""Checks against a live model, and the sums that say whether it has drifted."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from calibration.errors import UnsafeError
from calibration.evaluation.drift import check
from calibration.model.model import CalibratedModel
from calibration.numerics.statistics import CLIP, DECISION, REFERENCE, Cusum, score
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

SOURCE = load_rig("swdt82")
TRUE = RigTruth(SOURCE.rig, 1)
LOOSE = RigTruth(SOURCE.rig, 1, effects=parse_effects("backlash@theta4:width_rad=2e-3"))
SESSIONS = 12


@functools.cache
def model() -> CalibratedModel:
    return identify(SOURCE.rig, SOURCE.text, observed(TRUE, 40, 20), effects="none")


def observed(truth: RigTruth, poses: int, seed: int, setup: str = "S1") -> Observations:
    data = simulate_observations(truth, poses, seed, prisms=["r", "s"], setup=setup)
    return parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")


def alarm_after(truth: RigTruth, setup: str) -> int | None:
    """After how many check sessions of four poses the alarm is raised."""
    sums = Cusum()
    for number in range(SESSIONS):
        sums = sums.after(check(model(), observed(truth, 4, 1000 + number, setup)).scores)
        if sums.alarm == "worse":
            return number + 1
    return None


@pytest.mark.parametrize("setup", ["S1", "never seen"])
def test_a_machine_that_is_as_it_was_raises_no_alarm(setup: str) -> None:
    assert alarm_after(TRUE, setup) is None


def test_a_joint_that_got_loose_raises_the_alarm_within_a_few_sessions() -> None:
    known, unknown = alarm_after(LOOSE, "S1"), alarm_after(LOOSE, "never seen")
    assert known is not None
    assert known <= 2
    assert unknown is not None, "a base fitted on the check's own fixes takes up part of it, not all"


def test_the_ratio_is_that_of_errors_to_what_the_model_predicts() -> None:
    whole = [check(model(), observed(TRUE, 4, seed)).ratio for seed in range(200, 220)]
    assert 0.85 < math.sqrt(np.mean(np.square(whole))) < 1.15
    assert check(model(), observed(LOOSE, 4, 200)).ratio > 2.0


def test_scores_of_normal_errors_are_centred_and_no_wider_than_one() -> None:
    squares = np.random.default_rng(3).chisquare(3, 20_000) / 3.0
    scores = np.array([score(square) for square in squares])
    assert abs(scores.mean()) < 0.02
    assert abs(scores.std() - 1.0) < 0.02
    assert score(1e9) == CLIP
    assert score(0.0) == -CLIP


def test_one_wrong_shot_decides_nothing_and_does_not_spoil_the_next_sessions() -> None:
    sums = Cusum().after([0.0, 0.2, score(1e6), -0.1])
    assert sums.alarm == "none"
    assert sums.after([0.0] * 4).upper == 0.0


def test_the_sums_are_two_sided() -> None:
    once = REFERENCE + 1.0
    steps = math.ceil(DECISION) + 1
    assert Cusum().after([once] * steps).alarm == "worse"
    assert Cusum().after([-once] * steps).alarm == "better"
    assert Cusum().after([REFERENCE] * 1000).alarm == "none"
    assert Cusum(upper=3.0).after([once, once]) == Cusum(upper=5.0)


def test_false_alarms_are_rarer_than_one_in_ten_thousand_standstills() -> None:
    rng = np.random.default_rng(11)
    alarms, sums = 0, Cusum()
    for value in rng.standard_normal(40_000):
        sums = sums.after([float(np.clip(value, -CLIP, CLIP))])
        if sums.alarm != "none":
            alarms, sums = alarms + 1, Cusum()
    assert alarms <= 4


def test_fixes_that_place_no_base_at_an_unknown_set_up_are_refused() -> None:
    rows = observed(TRUE, 1, 5, "never seen")
    with pytest.raises(
        UnsafeError, match="the check shots cannot determine the base transform: at set-up 'never seen'"
    ):
        check(model(), rows)
