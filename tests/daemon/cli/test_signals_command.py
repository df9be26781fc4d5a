"""A column that no rig file names becomes a signal by `--signal`, and the model remembers it."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.rig.description import shipped_rig
from tests.commands import run
from tests.daemon.support.offline import held_out_csv, train_csv

MM_PER_DEG = 0.8
SAID = (
    "column 'tilt_x_deg' holds numbers but is not used; to use it, add --signal tilt_x_deg, or add to the rig file the "
    'three lines [[signal]], name = "tilt_x" and unit = "deg"'
)


def tilted(data: bytes, seed: int) -> str:
    """Measured fixes of an arm whose carrier's tilt raises the prism, as a sensor tells."""
    rows = list(csv.DictReader(io.StringIO(data.decode())))
    tilts = np.random.default_rng(seed).uniform(-5.0, 5.0, len(rows)).tolist()
    out = io.StringIO()
    writer = csv.DictWriter(out, [*rows[0], "tilt_x_deg", "operator"], lineterminator="\n")
    writer.writeheader()
    for row, tilt in zip(rows, tilts, strict=True):
        z_mm = float(row["z_mm"]) + MM_PER_DEG * tilt
        writer.writerow({**row, "z_mm": repr(z_mm), "tilt_x_deg": repr(tilt), "operator": "Ada"})
    return out.getvalue()


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("signals")
    (directory / "train.csv").write_text(tilted(train_csv(), 1), encoding="utf-8")
    (directory / "test.csv").write_text(tilted(held_out_csv(), 2), encoding="utf-8")
    return directory


def calibrated(work: Path, name: str, *more: object, rig: object = "ur10") -> dict[str, Any]:
    done = run(
        "calibrate", "--rig", rig, "--data", work / "train.csv", "--out", work / name, "--effects", "none",
        "--residual", "gp", "--json", *more,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@pytest.mark.long
def test_a_model_uses_and_remembers_the_signal_that_it_was_trained_with(work: Path) -> None:
    answer = calibrated(work, "model", "--signal", "tilt_x_deg")
    assert (answer["residual"], answer["ignored_columns"]) == ("gp", ["operator"])
    assert SAID not in answer["warnings"]

    told = json.loads(run("evaluate", "--model", work / "model", "--data", work / "test.csv", "--json").stdout)
    rms_mm = {stage["stage"]: stage["rms_mm"] for stage in told["stages"]}
    assert rms_mm["hybrid"] < 0.2 * rms_mm["effects"]
    predicted = run("predict", "--model", work / "model", "--data", work / "test.csv")
    rows = list(csv.DictReader(io.StringIO(predicted.stdout)))
    off_mm = np.array([float(row["z_pred_mm"]) - float(row["z_mm"]) for row in rows])
    assert float(np.sqrt((off_mm**2).mean())) < 0.4

    header, *without = (work / "test.csv").read_text(encoding="utf-8").splitlines()
    blind = work / "blind.csv"
    blind.write_text("\n".join([header.replace("tilt_x_deg", "tilt"), *without]), encoding="utf-8")
    told = json.loads(run("evaluate", "--model", work / "model", "--data", blind, "--json").stdout)
    assert any("the residual was trained with tilt_x_deg, which this data lacks" in w for w in told["warnings"])


@pytest.mark.long
def test_the_flag_and_the_lines_that_a_warning_says_make_the_same_model(work: Path) -> None:
    plain = calibrated(work, "plain")
    assert plain["warnings"].count(SAID) == 1
    assert plain["ignored_columns"] == ["tilt_x_deg", "operator"]
    lines = SAID.rpartition("the three lines ")[2].replace(" and ", ", ").split(", ")
    own = work / "own.toml"
    own.write_text("\n".join([shipped_rig("ur10").text, *lines]), encoding="utf-8")
    by_file, by_flag = calibrated(work, "file", rig=own), calibrated(work, "flag", "--signal", "tilt_x_deg")
    assert by_file["stages"] == by_flag["stages"] != plain["stages"]


@pytest.mark.long
def test_gap_finds_that_the_error_goes_with_the_signal(work: Path) -> None:
    common = ("--rig", "ur10", "--data", work / "train.csv", "--out", work / "gap", "--json")
    answer = json.loads(run("gap", *common, "--signal", "tilt_x_deg").stdout)
    assert answer["disagreements"][0]["variable"] == "tilt_x_deg"
    assert json.loads(run("gap", *common).stdout)["warnings"].count(SAID) == 1


@pytest.mark.parametrize(
    ("signal", "reason"),
    [
        ("tilt_y_deg", "train.csv, column tilt_y_deg: the file has no such column, although --signal names it"),
        ("tilt x", "'tilt x' cannot be the column of a signal"),
        ("temperature_degC", "the column temperature_degC is already defined; remove the signal"),
    ],
)
@pytest.mark.parametrize("command", ["calibrate", "gap", "compare"])
def test_a_signal_that_cannot_be_is_refused_in_a_sentence(work: Path, command: str, signal: str, reason: str) -> None:
    more = ("--holdout", work / "test.csv") if command == "compare" else ()
    out = work / "nothing"
    done = run(command, "--rig", "ur10", "--data", work / "train.csv", *more, "--out", out, "--signal", signal)
    assert (done.exit_code, done.stdout) == (2, "")
    assert reason in " ".join(done.stderr.split())
    assert not (out / "manifest.json").exists()


@pytest.mark.long
def test_outliers_are_named_by_their_lines_in_the_file(work: Path) -> None:
    header, *rows = train_csv().decode().splitlines()
    place = header.split(",").index("z_mm")
    spoilt = rows[30].split(",")
    spoilt[place] = str(float(spoilt[place]) + 60.0)
    rows[30] = ",".join(spoilt)
    lines = [header, "", *rows[:20], *rows[:10], "", *rows[20:]]  # empty lines and copies, which are left out
    (work / "spoilt.csv").write_text("\n".join(lines), encoding="utf-8")
    done = run(
        "calibrate", "--rig", "ur10", "--data", work / "spoilt.csv", "--out", work / "spoilt", "--effects", "none",
        "--residual", "none", "--json",
    )  # fmt: skip
    warnings = "\n".join(json.loads(done.stdout)["warnings"])
    line = lines.index(rows[30]) + 1
    assert "10 of 250 rows are exact copies of earlier rows, the first in line 23; copies are not counted" in warnings
    assert f"sigma off, in line {line}" in warnings
    assert f"line {line}" in (work / "spoilt" / "report.html").read_text(encoding="utf-8")
    model = json.loads((work / "spoilt" / "model.json").read_text(encoding="utf-8"))
    assert [outlier["row"] for outlier in model["outliers"]] == [line]
