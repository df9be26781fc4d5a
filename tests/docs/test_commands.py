"""Every command that the documentation gives is a command that works.

A block of commands without a title is run: in a directory of its own, in the order of the page, and ends with status 0.
A block with a title (`title="on the rig"`) needs what a test has not got; its commands are parsed by the real command
line.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.support.daemon_process import DaemonProcess
from tests.docs.pages import ROOT, Block, blocks, fault_of, fault_of_mention, inline_commands, pages

pytestmark = pytest.mark.timeout(1200)  # a busy computer compiles kernels for minutes

HOW_TO = "docs/how-to"
ALONE = ("connect", "import-arm", "import-measurements", "fleet")
WITH_A_MODEL = ("plan", "export")  # that of `calibrate`
WITH_A_RIG = ("replay", "store", "back-up", "monitor")  # on which `sessions` has held a session
LONG = ("docs/tutorial.md", f"{HOW_TO}/gap-report.md")


@functools.cache
def runnable(page: str) -> tuple[Block, ...]:
    return tuple(block for block in blocks(page) if block.language == "sh" and not block.title)


def run(page: str, directory: Path, **environment: str) -> None:
    """Run the blocks of a page that are to be run; what is printed is shown where one fails."""
    script = "\n".join(block.text for block in runnable(page))
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-exuo", "pipefail", "-c", script],
        cwd=directory,
        env={**os.environ, "PATH": path, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{page}: status {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


def test_every_page_with_commands_to_run_is_run_here() -> None:
    run_here = {f"{HOW_TO}/{name}.md" for name in ("calibrate", "sessions", *ALONE, *WITH_A_MODEL, *WITH_A_RIG)}
    assert {page for page in pages() if runnable(page)} == run_here | set(LONG)


@pytest.mark.long
@pytest.mark.parametrize("name", ALONE)
def test_a_page_runs_from_nothing(name: str, tmp_path: Path) -> None:
    run(f"{HOW_TO}/{name}.md", tmp_path)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the page that calibrates has been run."""
    directory = tmp_path_factory.mktemp("calibrated")
    run(f"{HOW_TO}/calibrate.md", directory)
    return directory


@pytest.mark.long
def test_the_page_that_calibrates_leaves_a_model_that_is_right(calibrated: Path) -> None:
    assert {"model", "predicted.csv", "commands.csv"} <= {path.name for path in calibrated.iterdir()}


@pytest.mark.long
@pytest.mark.parametrize("name", WITH_A_MODEL)
def test_a_page_runs_with_that_model(name: str, calibrated: Path, tmp_path: Path) -> None:
    run(f"{HOW_TO}/{name}.md", Path(shutil.copytree(calibrated, tmp_path / "copy")))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaemonProcess]:
    """A daemon on a simulated rig, on which the page of sessions has held one."""
    daemon = DaemonProcess(tmp_path_factory.mktemp("rig"), "--sim", "--rate", "5", jobs=False)
    try:
        daemon.wait("a fix", daemon.has_fix)
        run(f"{HOW_TO}/sessions.md", daemon.directory, RIGCAL_SOCKET=str(daemon.socket))
        yield daemon
    finally:
        daemon.stop()


@pytest.mark.long
def test_the_page_of_sessions_leaves_a_closed_one(rig: DaemonProcess) -> None:
    assert [(one["id"], one["state"]) for one in rig.say("session.list")] == [("s001-r", "closed")]


@pytest.mark.long
@pytest.mark.parametrize("name", WITH_A_RIG)
def test_a_page_runs_beside_a_daemon(name: str, rig: DaemonProcess) -> None:
    run(f"{HOW_TO}/{name}.md", rig.directory, RIGCAL_SOCKET=str(rig.socket))


@pytest.mark.parametrize("page", pages())
def test_every_command_on_a_page_is_known_to_the_command_line(page: str) -> None:
    faults = [fault_of(line) for block in blocks(page) if block.language == "sh" for line in block.commands]
    faults += [fault_of_mention(text) for text in inline_commands(page)]
    assert not list(filter(None, faults))


def test_everything_that_make_and_python_are_asked_for_is_there() -> None:
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8")))
    for page in pages():
        text = (ROOT / page).read_text(encoding="utf-8")
        for target in re.findall(r"(?m)(?:^|`)make ([a-z]+)", text):
            assert target in targets, (page, target)
        for module in re.findall(r"python -m ([a-z_0-9.]+[a-z_0-9])", text):
            assert importlib.util.find_spec(module), (page, module)
