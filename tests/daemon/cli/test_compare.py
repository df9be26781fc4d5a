from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from calibration.observations import format_observations
from calibration.rig.description import parse_rig
from simulators.rig.truth import RigTruth
from tests.bench.zhou2022 import sweeps, table
from tests.calibration.simulated_ys100 import robot, stiffening
from tests.commands import answer, run
from tests.simulated.observations import simulate_observations

TORSO = Path(__file__).parents[2] / "rigs" / "torso.toml"
RESIDUALS = ["effects", "table", "rbfn-paper", "rbfn", "lightgbm", "chain", "gp"]
METHODS = ["nominal", "km", "skcm", "rbf-tcm", *RESIDUALS, "default", "pde-paper"]
FIGURES = ["mean_mm", "max_mm", "std_mm", "rms_mm", "training_mean_mm"]


@pytest.fixture
def ys100(tmp_path: Path) -> list[object]:
    rig, training, held_out = robot(1002, stiffening(1002))
    for name, rows in (("train.csv", training), ("test.csv", held_out)):
        (tmp_path / name).write_text(format_observations(rows, rig), encoding="utf-8")
    return ["--rig", "ys100", "--data", tmp_path / "train.csv", "--holdout", tmp_path / "test.csv", "--out", tmp_path]


@pytest.fixture
def torso(tmp_path: Path) -> list[object]:
    """A rig file without masses: sweeps and other poses at one set-up, held-out poses at the same."""
    rig = parse_rig(TORSO.read_text(encoding="utf-8"), TORSO.name)
    truth = RigTruth(rig, 3)
    single = simulate_observations(truth, 5 * len(rig.joints), 3, poses=sweeps(rig, 5), setup="east")
    multi = simulate_observations(truth, 10, 4, setup="east")
    (tmp_path / "train.csv").write_text(table({"single": single, "multi": multi}), encoding="utf-8")
    held_out = simulate_observations(truth, 10, 5, setup="east")
    (tmp_path / "test.csv").write_text(held_out.csv_text(), encoding="utf-8")
    data, test = tmp_path / "train.csv", tmp_path / "test.csv"
    return ["--rig", TORSO, "--data", data, "--holdout", test, "--out", tmp_path / "new" / "pages"]


def pictures(page: str) -> int:
    return len(re.findall(r'<img alt="[^"]+" src="data:image/svg\+xml;base64,', page))


@pytest.mark.long
def test_the_answer_has_a_row_for_every_method_and_a_page(ys100: list[object]) -> None:
    found = answer("compare", *ys100, "--time-limit", 0.2)
    assert list(found) == ["rig", "n", "n_holdout", "noise_mm", "methods", "warnings", "page"]
    assert (found["rig"], found["n"], found["n_holdout"]) == ("ys100", 50, 50)
    assert [row["method"] for row in found["methods"]] == METHODS
    for row in found["methods"]:
        assert list(row) == ["method", *FIGURES, "seconds", "adds", "reason"]
        assert row["reason"] is None
        assert all(row[name] > 0 for name in FIGURES)
    assert [row["adds"] for row in found["methods"]][:4] == [[], [], ["joint_compliance"], ["rbf-tcm"]]
    assert any("pde-paper" in note and "stopped" in note for note in found["warnings"])
    page = Path(found["page"]).read_text(encoding="utf-8")
    assert Path(found["page"]).name == "comparison-ys100.html"
    assert pictures(page) == 2
    assert "rigcal has the lowest mean error" in page
    assert "Tolerance: no tolerance stated" in page


@pytest.mark.long
def test_a_person_gets_a_table_reasons_shared_rows_and_the_page_s_path(torso: list[object], tmp_path: Path) -> None:
    train, test = tmp_path / "train.csv", tmp_path / "test.csv"
    shared = train.read_text(encoding="utf-8").splitlines()[1]
    test.write_text(test.read_text(encoding="utf-8") + shared + "\n", encoding="utf-8")
    result = run("compare", *torso, "--time-limit", 0.2)
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    assert [column in lines[1] for column in ("method", "mean", "max", "std", "rms", "training", "seconds")] == [
        True
    ] * 7
    (best,) = (line for line in lines if line.strip().startswith("default"))
    assert "*" in best
    assert sum("not applicable" in line for line in lines if "masses" not in line) == 2
    assert sum("masses" in line for line in lines) == 2
    assert "1 of the 41 rows of test.csv are rows of train.csv as well, the first in line 42; " in result.stdout
    assert "comparison-torso.html" in lines[-1]


@pytest.mark.long
def test_the_protocol_prints_its_tables_and_draws_its_plots(torso: list[object], tmp_path: Path) -> None:
    result = run("compare", *torso, "--protocol", "zhou2022", "--time-limit", 0.1)
    assert result.exit_code == 0, result.stderr
    for title in ("Before calibration", "Table 3", "Chosen weights", "Learning curve", "Trajectory", "Please note"):
        assert title in result.stdout
    assert "the paper's DE (stopped)" in result.stdout
    assert "no single-joint sweep" not in result.stdout
    assert "stopped at the time limit" in result.stdout
    page = tmp_path / "new" / "pages" / "comparison-torso.html"
    assert result.stdout.splitlines()[-1].endswith(str(page))
    assert pictures(page.read_text(encoding="utf-8")) == 4


def test_wrong_use_is_refused_in_a_sentence(torso: list[object], tmp_path: Path) -> None:
    result = run("compare", *torso, "--protocol", "zhou2022", "--refit-base")
    assert result.exit_code == 2
    assert "omit --refit-base" in result.stderr
    test = tmp_path / "test.csv"
    test.write_text(test.read_text(encoding="utf-8").replace("east", "west"), encoding="utf-8")
    for protocol in ([], ["--protocol", "zhou2022"]):
        result = run("compare", *torso, *protocol, "--json")
        assert result.exit_code == 3
        assert "set-up 'west'" in json.loads(result.stdout)["error"]
