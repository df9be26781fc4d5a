"""`rigcal gap` on files that nobody should give it: an exit status and a sentence, or an answer that is sound."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any, NoReturn

import pytest
from click.testing import CliRunner

from daemon.cli.main import main as rigcal
from tests.daemon.support import gap as support

Table = dict[str, list[str]]


def table(poses: int, seed: int = 5, setup: str = "S1") -> Table:
    rows = list(csv.DictReader(io.StringIO(support.session_csv(poses, seed, setup).decode())))
    return {name: [row[name] for row in rows] for name in rows[0]}


def written(path: Path, columns: Table) -> Path:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    path.write_text(out.getvalue(), "utf-8")
    return path


def gap(directory: Path, data: Table, holdout: Table | None = None) -> tuple[int, dict[str, Any]]:
    """Exit status and the JSON object, strictly read."""
    files = ["--data", written(directory / "data.csv", data)]
    if holdout is not None:
        files += ["--holdout", written(directory / "holdout.csv", holdout)]
    arguments = ["gap", "--rig", "swdt82", *files, "--out", directory / "out", "--json"]
    result = CliRunner().invoke(rigcal, [str(a) for a in arguments])
    return result.exit_code, json.loads(result.stdout, parse_constant=refuse)


def refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


@pytest.mark.parametrize(
    ("name", "cell", "words"),
    [
        ("dwell_s", "-3.5", "line 2, column dwell_s: -3.5 is outside the possible range"),
        ("time_s", "1.7e12", "line 2, column time_s: 1.7e+12 is outside the possible range"),
        ("temperature_degC", "nan", "line 2, column temperature_degC: 'nan' is not a finite number"),
        ("theta4_dir", "0.5", "line 2, column theta4_dir: 0.5 is not a direction"),
        ("theta4_Nm", "1e300", "line 2, column theta4_Nm: 1e+300 is outside the possible range"),
    ],
)
def test_a_cell_that_no_machine_has_is_refused_with_its_place(tmp_path: Path, name: str, cell: str, words: str) -> None:
    data = table(5)
    data[name] = [cell, *["0"] * (len(data["prism"]) - 1)]
    status, answer = gap(tmp_path, data)
    assert status == 2
    assert words in answer["error"]
    assert not (tmp_path / "out").exists()


def rows(columns: Table, count: int) -> Table:
    return {name: cells[:count] for name, cells in columns.items()}


OTHER_RIG = {"prism": ["tmac"], "q1_deg": ["1"], "x_mm": ["1"], "y_mm": ["1"], "z_mm": ["1"]}


@pytest.mark.parametrize(
    ("data", "holdout", "expected", "words"),
    [
        (rows(table(5), 0), None, 2, "data.csv: no observations below the header"),
        (rows(table(5), 3), None, 3, "3 fixes have 9 coordinates, which cannot determine 56 parameters"),
        ({name: cells * 20 for name, cells in rows(table(5), 1).items()}, None, 3, "cannot place the base"),
        (table(20), OTHER_RIG, 2, "holdout.csv, line 1, column theta1_deg: column missing for rig 'swdt82'"),
        (table(20), rows(table(5), 0), 2, "holdout.csv: no observations below the header"),
        (
            table(20),
            table(5) | {"prism": ["q"] * 10},
            2,
            "holdout.csv, line 2, column prism: rig 'swdt82' has no prism",
        ),
        (table(20), table(5) | {"z_mm": [""] * 10}, 2, "holdout.csv, line 2, column z_mm: empty"),
    ],
)
def test_a_file_that_allows_no_answer_is_refused_with_the_reason(
    tmp_path: Path, data: Table, holdout: Table | None, expected: int, words: str
) -> None:
    status, answer = gap(tmp_path, data, holdout)
    assert (status, set(answer)) == (expected, {"error", "kind"})
    assert words in answer["error"]
    assert not (tmp_path / "out").exists()


def test_held_out_rows_of_an_unknown_setup_are_refused_with_what_to_do(tmp_path: Path) -> None:
    status, answer = gap(tmp_path, table(20), table(5, 6, "S2"))
    assert status == 3
    assert "set-up 'S2'" in answer["error"]
    assert "evaluate --refit-base" in answer["error"]
    assert not (tmp_path / "out").exists()


def test_a_place_where_nothing_can_be_written_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", "utf-8")
    for command in ("gap", "calibrate"):
        data = written(tmp_path / "data.csv", table(5))  # too few rows, which is said later
        out = tmp_path / "notes.txt" / "out"
        result = CliRunner().invoke(rigcal, [command, "--rig", "swdt82", "--data", str(data), "--out", str(out)])
        assert result.exit_code == 2
        assert "notes.txt is a file; name a different directory" in " ".join(result.stderr.split())


@pytest.mark.long
def test_useless_columns_change_nothing_and_the_answer_stays_sound(tmp_path: Path) -> None:
    data = table(20)
    rows = len(data["prism"])
    data["time_s"] = [repr(1.7e9 + float(t)) for t in data["time_s"]]
    data |= {"temperature_degC": ["20"] * rows, "payload_kg": ["500"] * rows, "theta1_bar": [""] * rows}
    data |= {"L2_bar": ["", "3.0", *[""] * (rows - 2)], "pump_mA": ["1e11", *["1e11"] * (rows - 1)]}
    data |= {"session": [f'<b>"{i % 2}&' for i in range(rows)], "<script>": ["x"] * rows}
    status, answer = gap(tmp_path, data)
    assert status == 0
    assert [(e["family"], e["where"]) for e in answer["effects"]] == [("backlash", "theta4")]
    assert {"thermal_expansion", "cylinder_compression"} <= set(answer["disabled"])
    assert answer["ignored_columns"] == ["<script>"]
    assert "<script>" not in (tmp_path / "out" / "report.html").read_text("utf-8")
