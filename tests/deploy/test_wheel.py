"""What is installed on a rig: the built wheel holds every file of the packages, data files and licences too."""

import shutil
import zipfile
from pathlib import Path

import pytest

from deploy.release.distributions import build_sdist, build_wheel, pack
from deploy.release.source import Source, version_of
from tests.deploy.conftest import REPOSITORY, run

PACKAGES = ["rigcal", "calibration", "drivers", "simulators", "daemon"]
FILES = ["pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md"]
EPOCH = 1_790_000_000


def copied(tree: Path) -> Source:
    """The sources as they are in the work tree, in a directory of their own: a build leaves its traces."""
    tree.mkdir()
    for name in FILES:
        shutil.copy(REPOSITORY / name, tree)
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, tree / package, ignore=shutil.ignore_patterns("__pycache__"))
    return Source(tree, version_of(tree), EPOCH)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Source:
    return copied(tmp_path_factory.mktemp("sources") / "tree")


@pytest.fixture(scope="module")
def wheel(sources: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(sources, tmp_path_factory.mktemp("wheel"))


def test_the_wheel_holds_every_file_of_the_packages(sources: Source, wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    ours = {
        str(file.relative_to(sources.tree))
        for package in PACKAGES
        for file in (sources.tree / package).rglob("*")
        if file.is_file()
    }
    assert sorted(ours - held) == []


def test_the_wheel_has_the_version_and_the_licences_of_all_that_is_inside(sources: Source, wheel: Path) -> None:
    about = f"rigcal-{sources.version}.dist-info"
    assert wheel.name == f"rigcal-{sources.version}-py3-none-any.whl"
    licences = {path.relative_to(REPOSITORY) for name in PACKAGES for path in (REPOSITORY / name).rglob("LICENSE")}
    assert licences, "uPlot comes with its own"
    held = zipfile.ZipFile(wheel).namelist()
    assert {f"{about}/licenses/{path}" for path in [Path("LICENSE"), *licences]} <= set(held)


@pytest.mark.slow
@pytest.mark.long
def test_an_sdist_is_the_same_bytes_twice_and_gives_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    sdists = [build_sdist(copied(tmp_path / name), tmp_path / f"{name}-out") for name in ("first", "second")]
    assert sdists[0].read_bytes() == sdists[1].read_bytes()
    assert run("tar", "-xf", sdists[0], "-C", tmp_path).returncode == 0
    unpacked = tmp_path / sdists[0].name.removesuffix(".tar.gz")
    again = build_wheel(Source(unpacked, version_of(unpacked), EPOCH), tmp_path / "wheel")
    assert again.read_bytes() == wheel.read_bytes()


def test_an_archive_depends_on_names_and_contents_alone(tmp_path: Path) -> None:
    files = {"b/x": b"1", "a": b"2"}
    for name, packed in (("first", files), ("second", dict(reversed(files.items())))):
        pack(packed, tmp_path / name, EPOCH)
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()
    listed = run("tar", "-tvzf", tmp_path / "first").stdout.splitlines()
    assert [line.split()[0] for line in listed] == ["-rw-r--r--"] * 2
    assert [line.split()[-1] for line in listed] == ["a", "b/x"]
