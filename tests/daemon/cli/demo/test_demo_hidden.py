from __future__ import annotations

import json
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.rig.description import Rig, shipped_rig
from daemon.acquisition.simulated_rig import SimulatedRig
from daemon.cli.demo.hidden import HIDDEN as HIDDEN_FILE
from daemon.cli.demo.hidden import Truth, concessions, outcome, rounds, show
from daemon.config.config import ConfigError
from drivers.clock import NS_PER_S, ScaledClock, Stamp, SystemClock
from simulators.blind.hiding import draw_hidden_effect
from simulators.effects.library import FAMILIES
from simulators.plan import APPROACH, stops_of
from simulators.rig.truth import RigTruth

RATE = 50.0
HIDDEN = Truth("backlash", "theta4", {"width_rad": 2e-3}, 2.0, 0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return shipped_rig("swdt82")


def middle(rig: Rig) -> dict[str, float]:
    return {joint.column: sum(joint.limits) / 2.0 for joint in rig.joints}


@dataclass(frozen=True)
class Played:
    """A simulated rig after its end.

    Attributes:
        truth: the effect that it had hidden.
        left: stops that the boom had not been at.
    """

    truth: Truth
    left: int


@pytest.fixture(scope="module")
def played(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Played:
    directory = tmp_path_factory.mktemp("rig")
    now = SystemClock().now()
    clock = ScaledClock(RATE, Stamp(now.utc_ns, now.monotonic_ns, f"simulated-{uuid.uuid4()}"))
    rates = {joint.name: joint.max_rate for joint in rig.joints}
    simulation = SimulatedRig("swdt82", rates, directory, clock, seed=4, secret=directory)
    try:
        truth = Truth(**json.loads((directory / HIDDEN_FILE).read_bytes()))
        simulation.drive_around(dwell_s=1.0)
        left = simulation.visit(stops_of(rig, [middle(rig) | {"theta4_dir": 1}], dwell_s=1.0))
        while left:
            time.sleep(0.02)
            left = simulation.visit([])
    finally:
        simulation.close()
    return Played(truth, left)


def test_the_machine_names_its_hidden_effect_and_the_seed_draws_it_again(rig: Rig, played: Played) -> None:
    truth = played.truth
    again = draw_hidden_effect(RigTruth(rig, 4), np.random.default_rng([4, 35]))
    assert again.as_dict() == {
        "family": truth.family,
        "where": truth.where,
        "coefficients": truth.coefficients,
        "visible_over_noise": truth.visible_over_noise,
    }
    assert truth.family in FAMILIES
    assert truth.begin_utc_ns < SystemClock().now().utc_ns + 3600 * NS_PER_S  # simulated time runs fast
    assert 1.0 <= truth.visible_over_noise <= 3.0


def test_the_simulated_boom_drives_to_the_poses_of_a_plan(played: Played) -> None:
    assert played.left == 0


@pytest.mark.parametrize("effect", ["foo@bar", "payload_change@theta4"])
def test_an_effect_that_the_simulated_machine_cannot_have_is_wrong_use(rig: Rig, tmp_path: Path, effect: str) -> None:
    clock = ScaledClock(RATE, Stamp(0, 0, "simulated"))
    with pytest.raises(ConfigError, match="refused its options"):
        SimulatedRig("swdt82", {}, tmp_path, clock, effects=(effect,))


def test_a_pose_that_says_from_which_side_is_reached_from_there(rig: Rig) -> None:
    row = middle(rig) | {"theta4_dir": 1, "L2_dir": -1, "dwell_s": 30.0}
    (before, passing_s), (pose, standing_s) = stops_of(rig, [row], dwell_s=4.0)
    assert before["theta4"] == pytest.approx(pose["theta4"] - APPROACH["deg"])
    assert before["L2"] == pytest.approx(pose["L2"] + APPROACH["mm"])
    assert before["theta3"] == pose["theta3"]
    assert (passing_s, standing_s) == (0.0, 30.0)
    assert len(stops_of(rig, [middle(rig)], dwell_s=4.0)) == 1
    at_the_end = middle(rig) | {"theta4_deg": rig.joint("theta4").limits[0], "theta4_dir": 1}
    assert len(stops_of(rig, [at_the_end], dwell_s=4.0)) == 1  # there is no way from below
    with pytest.raises(ValueError, match="theta4 = 1000 deg is beyond its limits"):
        stops_of(rig, [middle(rig) | {"theta4_deg": 1000.0}], dwell_s=4.0)
    with pytest.raises(ValueError, match="a pose needs a number for each of theta1_deg"):
        stops_of(rig, [{"theta1_deg": 1.0}], dwell_s=4.0)


def test_what_the_simulated_boom_does_less_than_a_plan_asks_is_said(rig: Rig) -> None:
    can = middle(rig) | {"pose": 1, "prisms": ["r"], "theta4_dir": 1.0, "dwell_s": 120.0, "time_s": 900.0}
    assert concessions(rig, [can]) == []
    later = can | {"time_s": 900.0 + 3 * 3600.0, "temperature_degC": 5.0, "L2_rate": 20.0}
    assert concessions(rig, [can, later]) == [
        "The plan's rounds span 3 h; here they span 30 min.",
        "Conditions that the simulated boom cannot fulfil and ignores: L2_rate, temperature_degC.",
    ]


def test_a_plan_is_measured_round_by_round_no_further_apart_than_half_an_hour() -> None:
    def plan(*times: float) -> list[dict[str, Any]]:
        return [{"pose": number, "time_s": time_s} for number, time_s in enumerate(times)]

    def told(rows: list[dict[str, Any]]) -> list[tuple[float, list[int]]]:
        return [(pause_s, [row["pose"] for row in part]) for pause_s, part in rounds(rows)]

    assert told(plan(900.0, 900.0, 1500.0)) == [(0.0, [0, 1]), (600.0, [2])]
    assert told(plan(900.0, 4500.0, 8100.0)) == [(0.0, [0]), (900.0, [1]), (900.0, [2])]
    assert told([{"pose": 0}, {"pose": 1}]) == [(0.0, [0, 1])]


def answer(effects: list[tuple[str, str]], pending: list[tuple[str, str]]) -> dict[str, Any]:
    verdict = "indistinguishable" if pending else "named" if effects else "none"
    told = {"width_rad": {"value": 2.1e-3, "unit": "rad", "standard_error": 1e-4}}
    return {
        "verdict": verdict,
        "effects": [{"family": family, "where": where, "coefficients": told} for family, where in effects],
        "indistinguishable": [{"family": family, "where": where, "posterior": 0.5} for family, where in pending],
        "description": None,
    }


BACKLASH, HYSTERESIS, SCALE = ("backlash", "theta4"), ("load_hysteresis", "theta4"), ("angle_scale", "theta3")


@pytest.mark.parametrize(
    ("effects", "pending", "expected", "line"),
    [
        ([BACKLASH], [], "right", "Right: it is backlash at theta4"),
        ([], [BACKLASH, HYSTERESIS], "set", "A set that contains it: it is backlash at theta4"),
        ([], [], "missed", "Missed: it is backlash at theta4"),
        ([HYSTERESIS], [], "missed", "Missed"),
        ([BACKLASH, SCALE], [], "missed", "Missed"),
        ([SCALE], [BACKLASH, HYSTERESIS], "missed", "Missed"),
        ([], [SCALE, HYSTERESIS], "missed", "Missed"),
        ([("backlash", "theta3")], [], "missed", "Missed"),
    ],
)
def test_an_answer_is_right_or_a_set_with_the_truth_or_missed(
    effects: list[tuple[str, str]],
    pending: list[tuple[str, str]],
    expected: str,
    line: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    gap = answer(effects, pending)
    assert outcome(gap, HIDDEN) == expected
    truth = {"family": HIDDEN.family, "where": HIDDEN.where, "coefficients": dict(HIDDEN.coefficients)}
    report = str(Path.cwd() / "rigcal-demo" / "gap" / "report.html")
    result = {"gap": gap, "truth": truth, "outcome": expected, "visible_over_noise": 2.0, "report": report}
    show(json.loads(json.dumps(result)))
    told = capsys.readouterr().out
    assert line in told
    assert told.endswith("report: rigcal-demo/gap/report.html\n")
