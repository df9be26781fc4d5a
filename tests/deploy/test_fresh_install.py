"""The wheel in a fresh virtual environment, outside the checkout: a user's first hour."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from deploy.release.distributions import build_wheel
from tests.deploy.conftest import REPOSITORY
from tests.deploy.test_wheel import copied

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]
PROBE = "pyserial"  # small, and nothing comes with it
DEADLINE_S = 120.0
SOCKET = "demo/control.sock"
FACE = """
import rigcal
rig = rigcal.Rig.read("ur10")
print(rigcal.__version__, rigcal.__file__, *(name for name in rigcal.__all__ if getattr(rigcal, name, None) is None))
"""


class Home:
    """A directory with an environment that holds rigcal and what its wheel asks for, at the locked versions."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.bin = directory / "venv/bin"
        kept = {"PATH", "HOME", "LANG", "TMPDIR"}
        # pip's settings say where packages come from; nothing else of this environment may help.
        self.environment = {n: v for n, v in os.environ.items() if n in kept or n.startswith(("PIP_", "SSL_"))}

    def run(self, program: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment in the directory."""
        command = [str(self.bin / program), *map(str, arguments)]
        return subprocess.run(
            command, cwd=self.directory, env=self.environment, capture_output=True, text=True, check=False
        )

    def rigcal(self, *arguments: str | Path) -> Any:
        """Return the JSON that a command prints."""
        done = self.run("rigcal", *arguments, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """The wheel, installed as a user installs it."""
    directory = tmp_path_factory.mktemp("home")
    home = Home(directory)
    subprocess.run([sys.executable, "-m", "venv", directory / "venv"], check=True)
    locked = re.findall(r"(?m)^[a-z][^ \\]*==[^\\]*", (REPOSITORY / "requirements.lock").read_text(encoding="utf-8"))
    (directory / "locked.txt").write_text("\n".join(line.strip() for line in locked), encoding="utf-8")
    quiet = ("--quiet", "--no-input", "--constraint", directory / "locked.txt")
    if home.run("pip", "download", *quiet, "--no-deps", "--dest", directory / "probe", PROBE).returncode != 0:
        pytest.skip("no package index can be reached from here, so the wheel was NOT installed in a fresh environment")
    wheel = build_wheel(copied(directory / "tree"), directory / "dist")
    done = home.run("pip", "install", *quiet, wheel)
    assert done.returncode == 0, done.stderr
    return home


def test_the_public_face_is_that_of_the_wheel(home: Home) -> None:
    done = home.run("python", "-c", FACE)
    assert done.returncode == 0, done.stderr
    version, place, *missing = done.stdout.split()
    assert Path(place).is_relative_to(home.directory / "venv")
    assert missing == []
    assert home.run("rigcal", "--version").stdout == f"rigcal, version {version}\n"
    assert home.run("pip", "show", "rigcal").stdout.split("Version: ")[1].startswith(f"{version}\n")


@pytest.fixture(scope="module")
def demo(home: Home) -> Iterator[dict[str, Any]]:
    """The demonstration's result; its daemon runs again, with its store and models."""
    result = home.rigcal("demo", "--out", "demo")
    machine = shlex.split((home.directory / "demo" / "simulated-machine.txt").read_text(encoding="utf-8"))
    with (home.directory / "daemon.log").open("w") as log:
        daemon = subprocess.Popen(
            [home.bin / "rigcal", "run", "--sim", "--config", "demo/rigcal.toml", *machine],
            cwd=home.directory,
            env=home.environment,
            stderr=log,
        )
    try:
        until = time.monotonic() + DEADLINE_S
        while home.run("rigcal", "status", "--socket", SOCKET).returncode != 0:
            assert time.monotonic() < until, (home.directory / "daemon.log").read_text(encoding="utf-8")
        yield result
    finally:
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(60) == 0


def test_the_demonstration_ends_with_a_model_that_can_be_accepted(home: Home, demo: dict[str, Any]) -> None:
    rms_mm = {found["stage"]: found["rms_mm"] for found in demo["evaluation"]["stages"]}
    # Which cells are held out differs from run to run: hybrid to geometric is 0.3 to 0.52.
    assert rms_mm["hybrid"] < 0.7 * rms_mm["geometric"] < rms_mm["nominal"]
    assert (home.directory / demo["report"]).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    newest = home.rigcal("model", "list", "--socket", SOCKET)["result"][-1]
    home.rigcal("model", "accept", str(newest["id"]), "--socket", SOCKET)
    models = home.rigcal("model", "list", "--socket", SOCKET)["result"]
    assert [model["id"] for model in models if model["state"] == "live"] == [newest["id"]]
