"""`rigcal inverse`: targets in, commands out, and a status that says whether all can be reached."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from daemon.models.model_files import write_model
from tests.commands import run
from tests.daemon.support.offline import held_out_csv, small_calibration

Table = list[dict[str, str]]
JOINTS = [f"q{i}_deg" for i in range(1, 7)]
PLACE = ["x_mm", "y_mm", "z_mm"]


def parsed(text: str) -> Table:
    return list(csv.DictReader(io.StringIO(text)))


def written(path: Path, rows: Table) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def numbers(rows: Table, columns: list[str]) -> np.ndarray:
    return np.array([[float(row[name]) for name in columns] for row in rows])


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("inverse") / "model"
    write_model(directory, small_calibration()[0])
    return directory


@pytest.fixture
def targets(tmp_path: Path) -> Path:
    """Measured fixes as targets: a few millimetres from where the model has the prism with these joints."""
    rows = [{**row, "note": "drill here"} for row in parsed(held_out_csv().decode())[:12]]
    return written(tmp_path / "targets.csv", rows)


@pytest.mark.long
def test_the_commands_bring_the_prisms_to_the_targets(model: Path, targets: Path, tmp_path: Path) -> None:
    done = run("inverse", "--model", model, "--data", targets)
    assert done.exit_code == 0, done.stderr
    before, commands = parsed(targets.read_text()), parsed(done.stdout)
    assert list(commands[0]) == [*before[0], "closure_mm"]
    assert [row["note"] for row in commands] == ["drill here"] * 12
    assert numbers(commands, ["closure_mm"]).max() <= 0.01
    change = numbers(commands, JOINTS) - numbers(before, JOINTS)
    assert 0.0 < np.abs(change).max() < 1.0
    predicted = run("predict", "--model", model, "--data", written(tmp_path / "commands.csv", commands))
    there = numbers(parsed(predicted.stdout), [f"{name[0]}_pred_mm" for name in PLACE])
    assert np.linalg.norm(there - numbers(before, PLACE), axis=1).max() <= 0.01


@pytest.mark.long
def test_a_target_out_of_reach_is_delivered_with_status_3(model: Path, targets: Path, tmp_path: Path) -> None:
    rows = parsed(targets.read_text())
    rows[4]["z_mm"] = "9000.0"
    far, out = written(tmp_path / "far.csv", rows), tmp_path / "commands.csv"
    done = run("inverse", "--model", model, "--data", far, "--out", out, "--json")
    answer = json.loads(done.stdout)
    assert done.exit_code == 3
    assert (answer["n"], answer["unreached_lines"], answer["out"]) == (12, [6], str(out))
    closures = numbers(parsed(out.read_text()), ["closure_mm"])[:, 0]
    assert closures[4] == pytest.approx(answer["worst_closure_mm"])
    assert closures[4] > 1000.0
    assert np.delete(closures, 4).max() <= 0.01
    assert any("1 of 12 targets are out of reach" in warning for warning in answer["warnings"])
    plain = run("inverse", "--model", model, "--data", far, "--out", out)
    assert plain.exit_code == 3
    assert plain.stdout == f"joint values for 12 positions written to {out} (replaced)\n"
    assert "Warning: 1 of 12 targets are out of reach" in plain.stderr


@pytest.mark.long
def test_commands_can_be_targets_again(model: Path, targets: Path, tmp_path: Path) -> None:
    once = run("inverse", "--model", model, "--data", targets, "--json")
    first = json.loads(once.stdout)["csv"]
    again = run("inverse", "--model", model, "--data", written(tmp_path / "again.csv", parsed(first)))
    assert list(parsed(again.stdout)[0]) == list(parsed(first)[0])
    np.testing.assert_allclose(numbers(parsed(again.stdout), JOINTS), numbers(parsed(first), JOINTS), atol=1e-6)


@pytest.mark.long
def test_wrong_use_is_refused_in_a_sentence(model: Path, targets: Path, tmp_path: Path) -> None:
    rows = parsed(targets.read_text())
    nowhere = written(tmp_path / "nowhere.csv", [{k: v for k, v in row.items() if k != "y_mm"} for row in rows])
    missing = run("inverse", "--model", model, "--data", nowhere)
    assert (missing.exit_code, missing.stdout) == (2, "")
    assert "column y_mm: column missing" in missing.stderr
    onto_itself = run("inverse", "--model", model, "--data", targets, "--out", targets)
    assert onto_itself.exit_code == 2
    assert "is the input file" in onto_itself.stderr
    rows[0]["pose"] = rows[1]["pose"] = "p"
    torn = run("inverse", "--model", model, "--data", written(tmp_path / "torn.csv", rows), "--json")
    assert torn.exit_code == 2
    assert "rows of one pose" in json.loads(torn.stdout)["error"]
