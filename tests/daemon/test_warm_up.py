"""What set-up and installation compile ahead, and what they say where that is for nothing."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from daemon.warm_up import main, place_of_caches

# What numba has of every function that it keeps on disk: after the warm-up, and after work on another machine's data.
DATA = Path(__file__).parents[1] / "data" / "ur10_random_poses.csv"
COMPILED_LATER = """
import sys
from pathlib import Path
from daemon.warm_up import main
status = main()
import numba
from calibration.observations import parse_observations
from calibration.model.prediction import Predictor
from calibration.pipeline.calibrate import calibrate
from daemon.rig_files import load_rig

def compiled():
    return {
        f"{f.py_func.__module__}.{f.py_func.__name__}": tuple(map(str, f.signatures))
        for module in list(sys.modules.values()) if module.__name__.startswith("calibration")
        for f in vars(module).values()
        if isinstance(f, numba.core.dispatcher.Dispatcher) and f.stats.cache_path is not None
    }

before = compiled()
source = load_rig("ur10")
header, *lines = Path(sys.argv[1]).read_bytes().splitlines(keepends=True)
table = parse_observations(b"".join([header, *lines[::15]]), source.rig, "ur10.csv")
for choice in {}, {"effects": "none", "residual": "lightgbm"}:
    model, _ = calibrate(source.rig, source.text, table, **choice)
    Predictor.of(model).predict(table)
after = compiled()
print(status, len(before) > 20, sorted(name for name in after if after[name] != before.get(name)))
"""


@pytest.mark.long
def test_a_calibration_after_the_warm_up_waits_for_no_compiler() -> None:
    command = [sys.executable, "-c", COMPILED_LATER, str(DATA)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout == "0 True []\n", done.stdout + done.stderr


@pytest.mark.parametrize("unusable", ["NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "HOME"])
def test_a_directory_that_cannot_be_written_is_named_with_the_one_in_its_place(tmp_path: Path, unusable: str) -> None:
    file = tmp_path / "file"
    file.write_text("not a directory")
    said = place_of_caches({unusable: str(file), "XDG_CACHE_HOME": str(tmp_path / "cache")})
    assert said is not None
    assert said.startswith(f"{file} cannot be written, so compiled kernels are kept in {tmp_path / 'cache'}")


@pytest.mark.parametrize("meant", ["NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "HOME"])
def test_nothing_is_said_of_a_directory_that_serves(tmp_path: Path, meant: str) -> None:
    assert place_of_caches({meant: str(tmp_path / "cache")}) is None


def test_without_any_directory_the_set_up_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("not a directory")
    monkeypatch.setattr(tempfile, "tempdir", str(file))
    assert main({"NUMBA_CACHE_DIR": str(file / "cache")}) == 0
    said = capsys.readouterr().err
    assert said.startswith("rigcal warm-up: NotADirectoryError")
    assert said.endswith("the first calibration compiles instead\n")
