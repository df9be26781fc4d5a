"""Every captured log yields exactly the readings that stand beside it. A log without its golden fails."""

from pathlib import Path

import pytest

from tests.golden.regenerate import CASES, HERE, REAL, SIMULATED, can_logs, replay

FOLDERS = sorted(path for kind in (SIMULATED, REAL) for path in kind.iterdir() if path.is_dir())


@pytest.mark.long
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_captured_log_yields_its_golden_readings(folder: Path, tmp_path: Path) -> None:
    golden = folder / "readings.jsonl"
    name = f"{folder.parent.name}/{folder.name}"
    assert golden.is_file(), f"{name} has no golden; make it with python -m tests.golden.regenerate {name}"
    for can_format in can_logs(folder) or ["log"]:
        replay(folder, tmp_path / f"{can_format}.jsonl", can_format)
        found = (tmp_path / f"{can_format}.jsonl").read_text(encoding="utf-8").splitlines()
        assert found == golden.read_text(encoding="utf-8").splitlines(), can_format


def test_every_simulated_case_has_its_folder_and_every_log_its_case() -> None:
    assert {path.name for path in FOLDERS if path.parent == SIMULATED} == set(CASES)
    stray = [p for p in HERE.rglob("*") if p.suffix in {".log", ".asc", ".blf", ".serial"} and p.parent not in FOLDERS]
    assert stray == []


def test_the_same_log_gives_the_same_bytes_every_time(tmp_path: Path) -> None:
    for name in ("first", "second"):
        replay(SIMULATED / "station-faults", tmp_path / f"{name}.jsonl")
    assert (tmp_path / "first.jsonl").read_bytes() == (tmp_path / "second.jsonl").read_bytes()
