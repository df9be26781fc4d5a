"""Machines that do not ship, described by a rig file alone, are calibrated to the noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.evaluation.evaluation import evaluate
from calibration.observations import Observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Rig, parse_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

RIGS = Path(__file__).parents[2] / "rigs"


def simulated(truth: RigTruth, poses: int, seed: int, setups: tuple[str, ...]) -> tuple[Observations, float]:
    """Fixes of all prisms at all set-ups in one table, and the noise among them, mm RMS."""
    header, rows, squares, fixes = "", [], 0.0, 0
    for number, setup in enumerate(setups):
        data = simulate_observations(truth, poses, seed + 100 * number, setup=setup)
        header, *lines = data.csv_text().splitlines()
        rows += lines
        squares += data.noise_rms_mm**2 * len(data)
        fixes += len(data)
    table = "\n".join([header, *rows, ""])
    return parse_observations(table.encode(), truth.rig, "simulated.csv"), float(np.sqrt(squares / fixes))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "poses", "setups"),
    [
        ("arm7", 120, ("",)),
        ("lift_arm", 60, ("",)),
        ("levers", 60, ("",)),
        ("slides", 60, ("",)),
        ("gantry", 60, ("",)),
        ("torso", 40, ("west", "east")),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_any_arm_is_calibrated_to_its_noise(name: str, poses: int, setups: tuple[str, ...], seed: int) -> None:
    text = (RIGS / f"{name}.toml").read_text(encoding="utf-8")
    rig: Rig = parse_rig(text, f"{name}.toml")
    truth = RigTruth(rig, seed)
    training, _ = simulated(truth, poses, seed, setups)
    held_out, noise_mm = simulated(truth, 200, seed + 50, setups)
    evaluation = evaluate(identify(rig, text, training), held_out)
    nominal, geometric, *_ = (float(s["rms_mm"]) for s in evaluation.stages())
    assert geometric < 1.25 * noise_mm < 0.5 * nominal
    deviation = evaluation.errors_mm["geometric"] / evaluation.sigma_mm
    assert 0.8 < float((deviation**2).mean()) < 1.25
