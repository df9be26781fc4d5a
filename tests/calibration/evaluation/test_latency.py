"""The latency of fixes, from fixes of a moving boom and a model of standing ones."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from calibration.evaluation.latency import Latency, estimate_latency
from calibration.model.model import CalibratedModel
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from daemon.rig_files import load_rig
from simulators.effects.library import parse_effects
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations
from tests.simulated.runs import simulate_runs

SOURCE = load_rig("swdt82")
STATIC = RigTruth(SOURCE.rig, 1)


def parsed(data: object) -> Observations:
    return parse_observations(data.csv_text().encode(), SOURCE.rig, "simulated.csv")  # type: ignore[attr-defined]


@functools.cache
def model() -> CalibratedModel:
    poses = parsed(simulate_observations(STATIC, 40, 20, prisms=["r", "s"], setup="S1"))
    return identify(SOURCE.rig, SOURCE.text, poses, effects="none")


def moving(effects: str, seed: int, setup: str = "S1", fixes: int = 120) -> Observations:
    truth = RigTruth(SOURCE.rig, 1, effects=parse_effects(effects) if effects else ())
    runs = parsed(simulate_runs(truth, 1, fixes, seed, prisms=["r"], setup=setup))
    return runs.select(runs.extra["dwell_s"] == 0.0)


def estimated(observations: Observations) -> Latency:
    found = estimate_latency(model(), observations)
    assert isinstance(found, Latency), found
    return found


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.2])
def test_the_latency_is_found_within_its_error_bars(seconds: float) -> None:
    effects = f"latency@clock:seconds={seconds}" if seconds else ""
    found = [estimated(moving(effects, seed)) for seed in range(30, 38)]
    scores = [(one.seconds - seconds) / one.standard_error_s for one in found]
    assert np.abs(scores).max() < 4.0
    assert np.sqrt(np.mean(np.square(scores))) < 1.8
    assert max(one.standard_error_s for one in found) < 0.03
    assert all(one.motions >= 5 for one in found)


def test_a_set_up_that_the_model_does_not_know_is_placed_by_the_fixes() -> None:
    found = estimated(moving("latency@clock:seconds=0.1", 40, setup="never seen"))
    assert abs(found.seconds - 0.1) < 4.0 * found.standard_error_s


def test_play_is_not_taken_for_latency() -> None:
    found = [estimated(moving("backlash@theta4:width_rad=2e-3", seed)) for seed in range(50, 54)]
    assert all(abs(one.seconds) < 4.0 * one.standard_error_s for one in found)


def test_a_boom_that_stands_tells_nothing_and_says_what_it_takes() -> None:
    standing = parsed(simulate_observations(STATIC, 40, 21, prisms=["r"], setup="S1"))
    assert estimate_latency(model(), standing) == "30 fixes in 5 motions are needed; there are 0 in 0"
