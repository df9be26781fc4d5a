from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from calibration.observations import parse_observations
from calibration.rig.description import Rig, shipped_rig
from daemon.models.model_files import write_model
from simulators.rig.truth import RigTruth
from tests.commands import answer, run
from tests.daemon.support.offline import small_calibration
from tests.simulated.observations import simulate_observations

KEYS = [
    "rig", "poses", "fixes", "seconds_of_motion", "parameters", "determined", "observability", "predicted_accuracy_mm",
    "present_accuracy_mm", "stands_out_sigma", "station_mm", "assumptions", "advice", "warnings",
]  # fmt: skip
STATISTICS = ["rms_mm", "mean_mm", "median_mm", "p95_mm", "p99_mm"]


def columns(rig: Rig) -> list[str]:
    return [joint.column for joint in rig.joints]


def test_the_answer_has_poses_motion_and_accuracy() -> None:
    rig = shipped_rig("ys100")
    found = answer("plan", "--rig", "ys100", "--poses", 15)
    assert list(found) == KEYS
    assert [row["pose"] for row in found["poses"]] == list(range(1, 16))
    for row in found["poses"]:
        assert list(row) == ["pose", *columns(rig), "prisms"]
        assert all(j.limits[0] <= row[j.column] <= j.limits[1] for j in rig.joints)
        assert row["prisms"] == ["tool"]
    assert found["fixes"] == 15
    assert found["seconds_of_motion"] > 0
    assert (found["parameters"], found["determined"]) == (32, 27)
    assert list(found["predicted_accuracy_mm"])[:5] == STATISTICS
    assert found["predicted_accuracy_mm"]["rms_mm"] < 0.1
    assert found["present_accuracy_mm"] is None
    assert any("--station" in sentence for sentence in found["assumptions"])
    assert found["warnings"] == []


def test_the_file_of_poses_can_be_driven(tmp_path: Path) -> None:
    rig = shipped_rig("swdt82")
    out = tmp_path / "poses.csv"
    found = answer("plan", "--rig", "swdt82", "--poses", 8, "--station", "0,-6000,1000", "--floor", -2000, "--out", out)
    assert found["out"] == str(out)
    assert found["station_mm"] == [0.0, -6000.0, 1000.0]
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert list(rows[0]) == ["pose", *columns(rig), "prisms"]
    assert [row["prisms"].split() for row in rows] == [row["prisms"] for row in found["poses"]]
    held = {joint.name: np.array([float(row[joint.column]) for row in rows]) for joint in rig.joints}
    data = simulate_observations(RigTruth(rig, 0), len(rows), 0, poses=held)
    assert len(parse_observations(data.csv_text().encode(), rig, "simulated.csv")) == 32


def test_people_get_a_table_that_is_not_cut_and_sentences() -> None:
    result = run("plan", "--rig", "ys100", "--poses", 4)
    assert result.exit_code == 0
    for text in (
        "theta6",
        "prisms",
        "of motion",
        "95 %",
        "Assumed",
        "reachable:",
        "too few: calibrating 32 parameters",
    ):
        assert text in result.stdout
    assert "…" not in result.stdout


def test_two_effects_are_told_apart_and_the_approach_is_part_of_the_plan(tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    pair = "backlash@theta3,joint_compliance@theta3"
    result = run("plan", "--rig", "ys100", "--poses", 10, "--separate", pair, "--out", out)
    assert result.exit_code == 0, result.stderr
    assert "theta3 from" in result.stdout
    assert "below" in result.stdout
    assert "backlash@theta3 of plausible size stands out from the others by" in result.stdout
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert {row["theta3_dir"] for row in rows} == {"-1", "1"}


def test_a_file_of_poses_that_was_there_before_is_said_to_be_replaced(tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    for note in ("", " (replaced)"):
        told = run("plan", "--rig", "ur10", "--poses", 3, "--out", out)
        assert told.stdout.endswith(f"Poses: {out}{note}\n")


@pytest.mark.long
def test_after_a_session_it_says_what_else_to_measure(tmp_path: Path) -> None:
    write_model(tmp_path / "model", small_calibration()[0])
    found = answer("plan", "--rig", "ur10", "--model", tmp_path / "model", "--poses", 12)
    assert list(found["present_accuracy_mm"]) == list(found["predicted_accuracy_mm"])
    assert found["predicted_accuracy_mm"]["parameters_mm"] < found["present_accuracy_mm"]["parameters_mm"]
    assert any("would lower the expected error over the work volume" in sentence for sentence in found["advice"])
    assert any("q1 was measured only at" in sentence for sentence in found["advice"])
    elsewhere = answer(
        "plan", "--rig", "ur10", "--model", tmp_path / "model", "--poses", 12, "--station", "0,-3000,500"
    )
    assert elsewhere["station_mm"] == [0.0, -3000.0, 500.0]
    assert "at the new set-up" in elsewhere["advice"][0]
    assert elsewhere["present_accuracy_mm"]["rms_mm"] == pytest.approx(found["present_accuracy_mm"]["rms_mm"], rel=0.05)
    refused = run("plan", "--rig", "ys100", "--model", tmp_path / "model", "--poses", 5)
    assert refused.exit_code == 3
    assert "the model is of rig 'ur10', not of 'ys100'" in refused.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--poses", "0"), "0 is not in the range"),
        (("--poses", "5", "--station", "1,2"), "'1,2' is not a position; give X,Y,Z in mm"),
        (("--poses", "5", "--station", "1,2,nan"), "is not a position"),
        (("--poses", "5", "--floor", "nan"), "'nan' is not a finite number"),
        (("--poses", "5", "--separate", "ghost@theta1,backlash@theta1"), "effect 'ghost' is unknown; there are"),
        (("--poses", "5", "--separate", "backlash@L9,backlash@theta1"), "backlash@L9: backlash may be at theta1"),
        (("--poses", "5", "--separate", "backlash@theta1"), "'backlash@theta1' is not two or three effects"),
        (("--poses", "5", "--separate", "joint_compliance@theta1,backlash@theta1"), "does nothing at theta1"),
        (("--poses", "5", "--setup", "A"), "names a set-up of a model; give --model"),
        (("--poses", "5", "--model", "/proc/nonexistent"), "/proc/nonexistent is not a directory"),
    ],
)
def test_wrong_use_is_one_sentence(arguments: tuple[str, ...], sentence: str) -> None:
    result = run("plan", "--rig", "ys100", *arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert "Traceback" not in result.stderr


def test_a_station_that_sees_nothing_is_refused() -> None:
    result = run("plan", "--rig", "ys100", "--poses", "5", "--station", "0,0,900000", "--json")
    assert result.exit_code == 3
    assert "none is reachable with a prism in view of the station" in json.loads(result.stdout)["error"]
