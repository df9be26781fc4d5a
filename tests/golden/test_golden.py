"""Every captured log yields exactly the readings that stand beside it. A log without its golden fails."""

from pathlib import Path

import pytest

from tests.golden.regenerate import CASES, HERE, replay

FOLDERS = sorted(path for path in HERE.iterdir() if path.is_dir() and not path.name.startswith("__"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
def test_a_captured_log_yields_its_golden_readings(folder: Path, tmp_path: Path) -> None:
    golden = folder / "readings.jsonl"
    assert golden.is_file(), (
        f"{folder.name} has no golden; make it with python -m tests.golden.regenerate {folder.name}"
    )
    logs = sorted(path.suffix.removeprefix(".") for path in folder.glob("boom.*"))
    assert logs
    for suffix in logs:
        replay(folder, suffix, tmp_path / f"{suffix}.jsonl")
        found = (tmp_path / f"{suffix}.jsonl").read_text(encoding="utf-8").splitlines()
        assert found == golden.read_text(encoding="utf-8").splitlines(), suffix


def test_every_case_has_its_folder_and_every_log_its_case() -> None:
    assert {path.name for path in FOLDERS} == set(CASES)
    stray = [p for p in HERE.rglob("*") if p.suffix in {".log", ".asc", ".blf", ".serial"} and p.parent not in FOLDERS]
    assert stray == []


def test_the_same_log_gives_the_same_bytes_every_time(tmp_path: Path) -> None:
    for name in ("first", "second"):
        replay(HERE / "station-faults", "log", tmp_path / f"{name}.jsonl")
    assert (tmp_path / "first.jsonl").read_bytes() == (tmp_path / "second.jsonl").read_bytes()
