"""What is installed on a rig: the built wheel holds every file of the four packages, data files too."""

import shutil
import sys
import zipfile
from pathlib import Path

from tests.deploy.conftest import REPOSITORY, run

PACKAGES = ["calibration", "drivers", "simulators", "daemon"]


def test_the_wheel_holds_every_file_of_the_packages(tmp_path: Path) -> None:
    # Built from a copy: a build leaves its traces in the tree.
    source = tmp_path / "source"
    source.mkdir()
    for name in ["pyproject.toml", "README.md", "LICENSE"]:
        shutil.copy(REPOSITORY / name, source)
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    result = run(*pip, "--wheel-dir", tmp_path, source)
    assert result.returncode == 0, result.stdout
    (wheel,) = tmp_path.glob("rigcal-*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    ours = {
        str(file.relative_to(source))
        for package in PACKAGES
        for file in (source / package).rglob("*")
        if file.is_file()
    }
    assert sorted(ours - held) == []
