from __future__ import annotations

import csv
import errno
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from calibration.effects.library import library
from calibration.errors import ModelError
from daemon.cli.commands.gap import show_gap
from daemon.host.safe_output import write_file
from daemon.models.gap_files import check_gap_target, gap_answer, write_gap
from daemon.models.model_files import read_model
from tests.commands import run
from tests.daemon.support import gap as support

CONTRACT = [
    "verdict", "effects", "indistinguishable", "description", "remaining", "disabled", "rms_before_mm", "rms_after_mm",
    "noise_mm", "holdout", "disagreements", "experiments", "seconds",
]  # fmt: skip
FILES = ["gap.json", "model", "report.html"]


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("gap")
    (directory / "session.csv").write_bytes(support.session_csv())
    shared = support.session_csv().splitlines(keepends=True)[1]
    (directory / "held_out.csv").write_bytes(support.session_csv(20, 77) + shared)
    return directory


@pytest.fixture(scope="module")
def found(directory: Path) -> dict[str, Any]:
    """What the command finds in a session of a boom with a backlash at theta4."""
    files = ("--data", directory / "session.csv", "--holdout", directory / "held_out.csv", "--out", directory / "out")
    result = run("gap", "--rig", "swdt82", *files, "--tolerance", "1000", "--json")
    assert result.exit_code == 0, result.stderr
    answer: dict[str, Any] = json.loads(result.stdout)
    return answer


@pytest.mark.long
def test_a_hidden_backlash_is_named_with_its_size_and_closes_the_gap(found: dict[str, Any]) -> None:
    assert set(CONTRACT) | {"rig", "n", "ignored_columns"} <= set(found)
    assert (found["verdict"], found["rig"], found["n"]) == ("named", "swdt82", 2 * support.POSES)
    (effect,) = found["effects"]
    assert (effect["family"], effect["where"]) == ("backlash", "theta4")
    width = effect["coefficients"]["width_rad"]
    assert abs(width["value"] - 3e-3) < 4.0 * width["standard_error"]
    assert effect["posterior"] > 0.95
    assert found["holdout"]["rms_after_mm"] < 1.3 * found["noise_mm"] < found["holdout"]["rms_before_mm"]
    assert found["disabled"]["thermal_expansion"] == "needs the column temperature_degC"
    assert found["rounds"][0]["adopted"] == ["backlash@theta4"]
    assert found["rounds"][0]["candidates"][1]["reason"]


@pytest.mark.long
def test_the_files_hold_the_answer_the_report_and_a_model_that_can_be_used(
    found: dict[str, Any], directory: Path
) -> None:
    out = directory / "out"
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert json.loads((out / "gap.json").read_text("utf-8")) == found
    assert "The simulation lacked backlash at theta4." in (out / "report.html").read_text("utf-8")
    result = run("evaluate", "--model", out / "model", "--data", directory / "held_out.csv", "--json")
    assert result.exit_code == 0, result.stderr
    stages = {stage["stage"]: stage["rms_mm"] for stage in json.loads(result.stdout)["stages"]}
    assert stages["effects"] == pytest.approx(found["holdout"]["rms_after_mm"], rel=1e-6)
    assert stages["geometric"] == pytest.approx(found["holdout"]["rms_before_mm"], rel=1e-6)


@pytest.mark.long
def test_held_out_rows_that_are_training_rows_are_named(found: dict[str, Any]) -> None:
    assert found["warnings"][0].startswith("1 of the 41 rows of held_out.csv are rows of session.csv as well")
    assert found["tolerance"]["verdict"] == "not judged"


def test_people_get_the_verdict_the_size_and_what_could_not_be_looked_for(capsys: pytest.CaptureFixture[str]) -> None:
    show_gap(support.named())
    told = capsys.readouterr().out
    for words in (
        "The simulation lacked backlash at theta4.", "width_rad", "theta4, by direction (p = 1e-12)",
        "thermal expansion: needs the column temperature_degC", "Joint L2 moved over less than a tenth of its range.",
    ):  # fmt: skip
        assert words in told


def test_bad_input_is_refused_and_nothing_is_written(directory: Path, tmp_path: Path) -> None:
    header, *rows = support.session_csv(5).decode().splitlines()
    (tmp_path / "bad.csv").write_text("\n".join([header.replace("theta4_deg", "theta44_deg"), *rows]), "utf-8")
    (tmp_path / "few.csv").write_text("\n".join([header, *rows[:2]]), "utf-8")
    for name, status in (("bad.csv", 2), ("few.csv", 3)):
        result = run("gap", "--rig", "swdt82", "--data", tmp_path / name, "--out", tmp_path / "out", "--json")
        assert result.exit_code == status, result.stderr
        assert set(json.loads(result.stdout)) == {"error", "kind"}
        assert not (tmp_path / "out").exists()


def test_a_directory_with_other_things_is_left_alone(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", "utf-8")
    result = run("gap", "--rig", "swdt82", "--data", directory / "session.csv", "--out", tmp_path)
    assert result.exit_code == 2
    assert "contains 'notes.txt', which is not part of a gap report" in result.stderr
    with pytest.raises(ModelError, match="is a file"):
        check_gap_target(tmp_path / "notes.txt")


@pytest.mark.long
def test_the_poses_asked_for_are_a_plan_that_goes_when_none_are_asked_for(tmp_path: Path) -> None:
    named = support.named()
    pending = replace(support.pending(), model=named.model)
    write_gap(tmp_path / "out", pending, gap_answer(pending, 1.5), "<html>")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "plan.csv").read_text("utf-8"))))
    assert [row["pose"] for row in rows] == ["1", "2", "3"]
    assert [row["prisms"] for row in rows] == ["r s"] * 3
    assert all(joint.column in rows[0] for joint in support.SOURCE.rig.joints)
    plan = json.loads((tmp_path / "out" / "plan.json").read_text("utf-8"))
    assert (plan["rig"], plan["poses"][0]["prisms"]) == ("swdt82", ["r", "s"])
    answer = json.loads((tmp_path / "out" / "gap.json").read_text("utf-8"))
    assert len(answer["experiments"][0]["poses"]) == 3
    assert answer["forecasts"][2]["nameable"] is None, "infinity is no JSON"
    sha256 = write_gap(tmp_path / "out", named, gap_answer(named, 1.5), "<html>")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    assert [e.family for e in read_model(tmp_path / "out" / "model", sha256).effects] == ["backlash"]


def test_an_answer_that_cannot_be_written_whole_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = support.named()
    write_gap(tmp_path / "out", named, gap_answer(named, 1.5), "<html>")
    earlier = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}

    def full(path: Path, data: bytes) -> None:
        if data == b"<html> too large":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_file(path, data)

    monkeypatch.setattr("daemon.models.gap_files.write_file", full)
    with pytest.raises(OSError, match="No space left"):
        write_gap(tmp_path / "out", named, gap_answer(named, 2.5), "<html> too large")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == earlier


# ---- the library -----------------------------------------------------------------------------------------------------


def effects(*arguments: str) -> list[dict[str, Any]]:
    result = run("effects", *arguments, "--json")
    assert result.exit_code == 0, result.stderr
    answer: dict[str, Any] = json.loads(result.stdout)
    return list(answer["effects"])


def test_every_family_says_all_of_itself() -> None:
    listed = effects()
    assert [family["family"] for family in listed] == list(library())
    for family in listed:
        assert all(family[key] for key in ("equation", "source", "revealed_by"))
        if family["family"] == "measured_tilt":  # the boom has no inclinometer
            assert family["places"] == []
            continue
        (first, *_) = family["places"]
        for coefficient in first["coefficients"]:
            if coefficient["lower"] is not None:
                assert coefficient["lower"] < coefficient["sigma"] < coefficient["upper"], family["family"]
        assert first["coefficients"], family["family"]


def test_places_and_plausible_sizes_are_those_of_the_rig() -> None:
    (swdt82,), (ur10,) = (effects("joint_compliance", "--rig", rig) for rig in ("swdt82", "ur10"))
    assert [place["where"] for place in ur10["places"]][:3] == ["q1", "q2", "q3"]
    sizes = [
        next(p["coefficients"][0]["sigma"] for p in family["places"] if p["coefficients"]) for family in (swdt82, ur10)
    ]
    assert 1e-9 < sizes[0] < sizes[1] < 1e-4, "the boom is heavier, so the same deflection is a smaller compliance"


def test_one_effect_is_told_in_full_and_a_misspelt_one_refused() -> None:
    told = run("effects", "backlash")
    assert told.exit_code == 0
    for words in ("width_rad", "confused with: load_hysteresis", "approaching the same pose", "the column <joint>_dir"):
        assert words in told.stdout
    refused = run("effects", "backslash")
    assert refused.exit_code == 2
    assert "'backslash' is unknown; known: angle_scale" in refused.stderr
    assert "angle_scale" in run("effects").stdout
