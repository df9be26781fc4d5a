from __future__ import annotations

import csv
import io
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.pipeline import methods
from daemon.cli.commands.calibrate import METHODS
from daemon.cli.commands.predict import INTERVAL_COLUMNS, PREDICTED_COLUMNS
from daemon.models.model_files import write_model
from tests.commands import run
from tests.daemon.support.offline import held_out_csv, small_calibration, train_csv

KEYS = [
    "rig", "n", "fitted", "seconds", "stages", "per_prism", "effects", "residual", "residual_reason", "noise_mm",
    "identifiability", "warnings", "ignored_columns", "expected_accuracy", "axes", "importance", "intervals",
]  # fmt: skip
STAGES = ["nominal", "geometric", "effects", "hybrid"]
STAGE_KEYS = ["stage", "mean_mm", "rms_mm", "max_mm", "std_mm"]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with train.csv, test.csv and a model of the former."""
    directory = tmp_path_factory.mktemp("offline")
    (directory / "train.csv").write_bytes(train_csv())
    (directory / "test.csv").write_bytes(held_out_csv())
    write_model(directory / "model", small_calibration()[0])
    return directory


@pytest.fixture
def here(tmp_path: Path) -> Iterator[Path]:
    old = Path.cwd()
    os.chdir(tmp_path)
    yield tmp_path
    os.chdir(old)


def assert_contract(answer: dict[str, Any], n: int) -> None:
    assert list(answer) == KEYS
    assert (answer["rig"], answer["n"]) == ("ur10", n)
    assert answer["seconds"] >= 0
    for stages in (answer["stages"], answer["per_prism"]["tmac"]):
        assert [stage["stage"] for stage in stages] == STAGES
        assert all(list(stage) == STAGE_KEYS for stage in stages)
    assert list(answer["identifiability"])[:3] == ["parameters", "rank", "unidentifiable"]


@pytest.mark.long
def test_calibrate_then_evaluate_as_programs(work: Path, tmp_path: Path) -> None:
    program = "from daemon.cli.main import main; main()"

    def command(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-W", "error", "-c", program, *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            cwd=Path(__file__).parents[3],
        )

    out = tmp_path / "model"
    done = command(
        "calibrate", "--rig", "ur10", "--data", work / "train.csv", "--out", out,
        "--effects", "none", "--residual", "none", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert_contract(answer, 240)
    rms = {stage["stage"]: stage["rms_mm"] for stage in answer["stages"]}
    assert rms["geometric"] == rms["effects"] == rms["hybrid"] < 0.6 < rms["nominal"]
    assert answer["residual"] is None
    assert answer["residual_reason"] == "switched off"
    assert "On the 240 fixes it was fitted to" in (out / "report.html").read_text(encoding="utf-8")
    assert "report.html" not in (out / "manifest.json").read_text()

    done = command("evaluate", "--model", out, "--data", work / "test.csv", "--json")
    assert done.returncode == 0, done.stderr
    assert_contract(json.loads(done.stdout), 60)


@pytest.mark.long
def test_a_residual_that_was_asked_for_and_is_left_out_says_why(work: Path, tmp_path: Path) -> None:
    few = tmp_path / "few.csv"
    few.write_text("".join((work / "train.csv").read_text().splitlines(keepends=True)[:41]))
    asked = ("calibrate", "--rig", "ur10", "--data", few, "--out", tmp_path / "model", "--effects", "none")
    why = "gp was requested and is left out:"
    told = run(*asked, "--residual", "gp")
    assert (told.exit_code, why in " ".join(told.stdout.split())) == (0, True)
    answer = json.loads(run(*asked, "--residual", "gp", "--json").stdout)
    assert answer["residual"] is None
    assert answer["residual_reason"].startswith(why)


def test_evaluate_prints_every_stage_for_people(work: Path) -> None:
    result = run("evaluate", "--model", work / "model", "--data", work / "test.csv")
    assert result.exit_code == 0
    told = " ".join(result.stdout.split())  # where lines end depends on the numbers in them
    for text in (*STAGES, "tmac", "scatter of a fix", "lightgbm", "parameters determined", "Not determined"):
        assert text in told


@pytest.mark.parametrize(
    ("tolerance_mm", "data", "verdict"),
    [("1000", "test.csv", "passed"), ("0.001", "test.csv", "failed"), ("1000", "train.csv", "not judged")],
)
def test_evaluate_holds_the_error_against_a_tolerance(work: Path, tolerance_mm: str, data: str, verdict: str) -> None:
    asked = ("evaluate", "--model", work / "model", "--data", work / data, "--tolerance", tolerance_mm)
    assert verdict.capitalize() + ": " in run(*asked).stdout
    answer = json.loads(run(*asked, "--json").stdout)
    assert answer["tolerance"]["verdict"] == verdict
    assert answer["tolerance"]["rms_mm"] == answer["stages"][-1]["rms_mm"]


def test_no_rewritten_file_of_the_training_passes(work: Path, tmp_path: Path) -> None:
    head, *rows = train_csv().decode().splitlines()
    other = held_out_csv().decode().splitlines()[1:]
    for name, kept in {"turned.csv": rows[::-1], "mixed.csv": [*rows[:5], *other]}.items():
        (tmp_path / name).write_text("\n".join([head, *kept]) + "\n", encoding="utf-8")
    for name, fitted in {"turned.csv": len(rows), "mixed.csv": 5}.items():
        asked = ("evaluate", "--model", work / "model", "--data", tmp_path / name, "--tolerance", "1000")
        answer = json.loads(run(*asked, "--json").stdout)
        assert (answer["fitted"], answer["tolerance"]["verdict"]) == (fitted, "not judged")
    assert f"{fitted} of which it was fitted to" in " ".join(run(*asked).stdout.split())


def test_a_base_that_was_fitted_on_few_fixes_passes_no_tolerance(work: Path, tmp_path: Path) -> None:
    rows = held_out_csv().decode().splitlines()[:6]
    (tmp_path / "few.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    asked = (
        "evaluate",
        "--model",
        work / "model",
        "--data",
        tmp_path / "few.csv",
        "--refit-base",
        "--tolerance",
        "1000",
    )
    assert json.loads(run(*asked, "--json").stdout)["tolerance"]["verdict"] == "not judged"


def test_gross_errors_are_told_by_their_lines(work: Path, tmp_path: Path) -> None:
    head, *rows = held_out_csv().decode().splitlines()
    at = head.split(",").index("x_mm")
    cells = [row.split(",") for row in rows]
    for row in (3, 7):
        cells[row][at] = str(float(cells[row][at]) + 3000.0)
    (tmp_path / "gross.csv").write_text("\n".join([head, *map(",".join, cells)]) + "\n", encoding="utf-8")
    answer = json.loads(run("evaluate", "--model", work / "model", "--data", tmp_path / "gross.csv", "--json").stdout)
    (told,) = [text for text in answer["warnings"] if "farther off than noise explains" in text]
    assert told.startswith("2 of 60 fixes")
    assert "lines 5, 9" in told or "lines 9, 5" in told


def test_evaluate_answers_with_the_contract(work: Path) -> None:
    result = run("evaluate", "--model", work / "model", "--data", work / "test.csv", "--json")
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    assert_contract(answer, 60)
    assert answer["residual"] == "lightgbm"


def test_predict_writes_the_input_columns_and_its_own(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "predicted.csv"
    result = run("predict", "--model", work / "model", "--data", work / "test.csv", "--out", out)
    assert (result.exit_code, result.stdout) == (0, f"60 positions written to {out}\n")
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    given = list(csv.DictReader(io.StringIO(held_out_csv().decode())))
    assert list(rows[0]) == [*given[0], *PREDICTED_COLUMNS]
    assert [{name: row[name] for name in given[0]} for row in rows] == given
    measured = np.array([[float(row[f"{c}_mm"]) for c in "xyz"] for row in rows])
    predicted = np.array([[float(row[f"{c}_pred_mm"]) for c in "xyz"] for row in rows])
    sigma = np.array([[float(row[f"sigma_{c}_pred_mm"]) for c in "xyz"] for row in rows])
    assert np.linalg.norm(measured - predicted, axis=1).max() < 3.0
    assert (sigma > 0).all()


def test_a_file_of_predictions_that_was_there_before_is_said_to_be_replaced(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "predicted.csv"
    asked = ("predict", "--model", work / "model", "--data", work / "test.csv", "--out", out)
    json_keys = [list(json.loads(run(*asked, "--json").stdout)) for _ in range(2)]
    assert json_keys[0] == json_keys[1]
    assert run(*asked).stdout == f"60 positions written to {out} (replaced)\n"


@pytest.mark.long
def test_a_model_that_was_there_before_is_said_to_be_replaced(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "model"
    asked = ("calibrate", "--rig", "ur10", "--data", work / "train.csv", "--out", out)
    for note in ("", " (replaced)"):
        told = run(*asked, "--effects", "none", "--residual", "none")
        assert told.exit_code == 0, told.stderr
        assert f"Model: {out}{note}   report: " in told.stdout


def test_predict_gives_intervals_where_they_are_asked_for(work: Path) -> None:
    result = run("predict", "--model", work / "model", "--data", work / "test.csv", "--intervals")
    assert result.exit_code == 0
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert tuple(rows[0])[-10:] == (*PREDICTED_COLUMNS, *INTERVAL_COLUMNS)
    table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name.endswith("_mm")}
    error = np.column_stack([table[f"{c}_mm"] - table[f"{c}_pred_mm"] for c in "xyz"])
    half = np.column_stack([table[f"half90_{c}_pred_mm"] for c in "xyz"])
    assert 0.8 < (np.abs(error) <= half).mean() < 0.98
    assert 0.75 < (np.linalg.norm(error, axis=1) <= table["radius90_pred_mm"]).mean() <= 1.0


@pytest.mark.parametrize("command", ["predict", "evaluate"])
def test_data_of_another_rig_is_refused_with_a_sentence(work: Path, tmp_path: Path, command: str) -> None:
    data = tmp_path / "boom.csv"
    data.write_text("prism,theta1_deg,theta3_deg,x_mm,y_mm,z_mm\nr,1,2,3,4,5\n")
    result = run(command, "--model", work / "model", "--data", data)
    assert result.exit_code == 2
    assert "column q1_deg: column missing for rig 'ur10'" in result.output


def test_predict_needs_no_positions_and_keeps_columns_it_does_not_know(work: Path, tmp_path: Path) -> None:
    joints = ",".join(f"q{i}_deg" for i in range(1, 7))
    data = tmp_path / "joints.csv"
    data.write_text(f'\ufeffnote,prism,{joints},x_pred_mm\n\n"a, b",tmac,-230,-150,95,-110,60,0,old\n')
    result = run("predict", "--model", work / "model", "--data", data)
    assert result.exit_code == 0
    header, row = csv.reader(io.StringIO(result.stdout))
    assert header == ["note", "prism", *joints.split(","), *PREDICTED_COLUMNS]
    assert row[0] == "a, b"
    assert np.isfinite([float(cell) for cell in row[8:]]).all()


def test_predict_in_json_carries_the_table(work: Path) -> None:
    arguments = ("predict", "--model", work / "model", "--data", work / "test.csv")
    answer = json.loads(run(*arguments, "--json").stdout)
    assert answer["n"] == 60
    assert answer["csv"] == run(*arguments).stdout


def test_prediction_and_evaluation_agree(work: Path) -> None:
    table = run("predict", "--model", work / "model", "--data", work / "test.csv").stdout
    rows = list(csv.DictReader(io.StringIO(table)))
    error = [[float(row[f"{c}_mm"]) - float(row[f"{c}_pred_mm"]) for c in "xyz"] for row in rows]
    rms = float(np.sqrt(np.mean(np.sum(np.square(error), axis=1))))
    answer = json.loads(run("evaluate", "--model", work / "model", "--data", work / "test.csv", "--json").stdout)
    assert answer["stages"][-1]["rms_mm"] == pytest.approx(rms, rel=1e-9)


def test_another_setup_is_refused_unless_its_base_is_fitted(work: Path, tmp_path: Path) -> None:
    header, *rows = held_out_csv().decode().splitlines()
    data = tmp_path / "moved.csv"
    data.write_text("\n".join([header + ",setup", *(row + ",tuesday" for row in rows)]) + "\n")
    arguments = ("evaluate", "--model", work / "model", "--data", data, "--json")
    refused = run(*arguments)
    assert refused.exit_code == 3
    assert "tuesday" in json.loads(refused.stdout)["error"]
    fitted = run(*arguments, "--refit-base")
    assert fitted.exit_code == 0
    answer = json.loads(fitted.stdout)
    assert any("tuesday" in warning and "fitted" in warning for warning in answer["warnings"])
    assert answer["stages"][1]["rms_mm"] < 0.7


def test_too_few_fixes_are_refused_as_unsafe(tmp_path: Path) -> None:
    data = tmp_path / "few.csv"
    data.write_bytes(b"".join(train_csv().splitlines(keepends=True)[:6]))
    result = run("calibrate", "--rig", "ur10", "--data", data, "--out", tmp_path / "model", "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["kind"] == "UnsafeError"
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--method", "oracle"), "'oracle' is not one of"),
        (("--effects", "witchcraft@q1"), "effect 'witchcraft' is unknown; there are"),
        (("--effects", "angle_scale@theta1"), "angle_scale may be at q1, q2, q3, q4, q5, q6 in rig 'ur10'"),
        (("--method", "km", "--effects", "angle_scale@q1"), "--method km does not support effects"),
        (("--residual", "oracle"), "'oracle' is not one of"),
        (("--seed", "-1"), "-1 is not in the range x>=0"),
        (("--rig", "digger"), "digger: neither a shipped rig"),
        (("--rig", "swdt82"), "train.csv, line 1, column theta1_deg: column missing for rig 'swdt82'"),
        (("--data", "nothing.csv"), "'nothing.csv' does not exist"),
    ],
)
def test_wrong_use_ends_in_status_2_and_says_what_there_is(
    work: Path, here: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    given = ["calibrate", "--rig", "ur10", "--data", work / "train.csv", "--out", "model"]
    result = run(*given, *arguments)
    assert result.exit_code == 2
    assert sentence in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr
    result = run(*given, *arguments, "--json")
    assert result.exit_code == 2
    assert sentence in json.loads(result.stdout)["error"]
    assert not (here / "model").exists()


def test_bad_data_is_refused_with_its_place(work: Path, tmp_path: Path) -> None:
    data = tmp_path / "bad.csv"
    data.write_bytes(held_out_csv().replace(b"tmac,", b"tmac,x", 1))
    result = run("evaluate", "--model", work / "model", "--data", data)
    assert result.exit_code == 2
    assert "bad.csv, line 2, column q1_deg" in result.stderr


def test_a_damaged_model_is_refused_in_one_sentence(work: Path, tmp_path: Path) -> None:
    write_model(tmp_path / "model", small_calibration()[0])
    text = tmp_path / "model" / "lightgbm_x.txt"
    text.write_bytes(text.read_bytes()[:1000])
    result = run("predict", "--model", tmp_path / "model", "--data", work / "test.csv")
    assert result.exit_code == 2
    assert "lightgbm_x.txt is truncated" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_directory_that_is_no_model_is_never_overwritten(work: Path, tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    result = run("calibrate", "--rig", "ur10", "--data", work / "train.csv", "--out", tmp_path)
    assert result.exit_code == 2
    assert "neither empty nor a model directory" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


@pytest.mark.parametrize("command", ["calibrate", "evaluate", "predict"])
def test_every_command_explains_itself(command: str) -> None:
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "--data" in result.stdout
    assert "--json" in result.stdout


def test_an_output_that_is_a_device_a_pipe_or_the_data_itself_is_refused(work: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    data = tmp_path / "data.csv"
    data.write_bytes((work / "test.csv").read_bytes())
    for out in (pipe, data):
        refused = run("predict", "--model", work / "model", "--data", data, "--out", out)
        assert refused.exit_code in {1, 2}
        assert str(out) in refused.stderr
    assert pipe.is_fifo()
    assert data.read_bytes() == (work / "test.csv").read_bytes()
    link, target = tmp_path / "link.csv", tmp_path / "target.csv"
    target.write_text("old", encoding="utf-8")
    link.symlink_to(target)
    assert run("predict", "--model", work / "model", "--data", data, "--out", link).exit_code == 0
    assert link.is_symlink()
    assert target.read_text(encoding="utf-8").startswith("prism,")


def test_every_method_of_the_command_is_one_of_the_mathematics() -> None:
    assert tuple(methods.METHODS) == METHODS


@pytest.mark.long
def test_a_killed_search_goes_on_where_it_was(work: Path, tmp_path: Path) -> None:
    out, checkpoint = tmp_path / "model", tmp_path / "model.checkpoint"
    data = tmp_path / "few.csv"
    data.write_bytes(b"".join(train_csv().splitlines(keepends=True)[:31]))
    given = ["calibrate", "--rig", "ur10", "--data", str(data), "--out", str(out), "--method", "pde-paper", "--json"]
    program = "from daemon.cli.main import main; main()"
    with subprocess.Popen([sys.executable, "-c", program, *given], stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120.0
        while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.kill()
    assert checkpoint.exists()
    result = run(*given, "--residual", "none", "--time-limit", "0.001")
    assert result.exit_code == 0, result.stdout
    assert any("stopped before its end" in warning for warning in json.loads(result.stdout)["warnings"])
    assert not checkpoint.exists()
    provenance = json.loads((out / "model.json").read_text(encoding="utf-8"))["provenance"]
    evaluations = int(re.search(r"([\d,]+) evaluations", provenance["search"])[1].replace(",", ""))  # type: ignore[index]
    assert evaluations >= 21 * 30_000  # 20 generations from the checkpoint; a search begun anew would have seen one


def test_a_refusal_leaves_no_checkpoint_behind(work: Path, tmp_path: Path) -> None:
    checkpoint = tmp_path / "model.checkpoint"
    checkpoint.write_bytes(b"of an earlier run that was killed")
    data = tmp_path / "few.csv"
    data.write_bytes(b"".join(train_csv().splitlines(keepends=True)[:4]))
    assert run("calibrate", "--rig", "ur10", "--data", data, "--out", tmp_path / "model").exit_code == 3
    assert not checkpoint.exists()


def test_a_cluster_that_is_not_there_is_named(work: Path, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daemon.cli.commands.calibrate.CONNECT_TIMEOUT_S", 0.2)
    result = run(
        "calibrate", "--rig", "ur10", "--data", work / "train.csv", "--out", "m", "--dask", "tcp://127.0.0.1:1"
    )
    assert result.exit_code == 2
    assert "no dask scheduler at tcp://127.0.0.1:1" in " ".join(result.stderr.split())
