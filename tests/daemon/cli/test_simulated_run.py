"""`rigcal run --sim` without a configuration: what it leaves, and what is told when its simulated rig has died."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.commands import answer_apart, run_apart

DEADLINE_S = 120.0


@contextlib.contextmanager
def running(directory: Path, rig: str) -> Iterator[subprocess.Popen[bytes]]:
    """A daemon on a simulated rig in a directory; it must end well."""
    state = directory / "rigcal-sim"
    with (directory / "log").open("w") as log:
        command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--rig", rig, "--rate", "5"]
        daemon = subprocess.Popen(command, cwd=directory, stdout=log, stderr=log)

    def is_there() -> bool:
        assert daemon.poll() is None, (directory / "log").read_text()
        return (state / "rigcal.toml").exists() and (state / "control.sock").exists()

    try:
        wait(is_there)
        yield daemon
    finally:
        daemon.send_signal(signal.SIGINT)
        assert daemon.wait(timeout=60) == 0


def wait(done: Callable[[], object]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.parametrize("rig", ["swdt82", "ur10"])
@pytest.mark.long
def test_a_simulated_rig_leaves_a_configuration_for_commands_on_its_store(rig: str, tmp_path: Path) -> None:
    """Joints that ur10's file reads from nowhere have simulated channels, which the configuration knows too."""
    config = tmp_path / "rigcal-sim" / "rigcal.toml"
    with running(tmp_path, rig):
        assert answer_apart("status", "--config", str(config))["mode"] == "simulated"
    assert answer_apart("config", "check", str(config)) == {
        "rig": rig,
        "links": ["boom", "station"],
        "fill_in": [],
    }
    assert answer_apart("store", "check", "--config", str(config))


@pytest.mark.long
def test_a_simulated_rig_that_has_died_is_told_instead_of_a_plug(tmp_path: Path) -> None:
    where = ("--socket", str(tmp_path / "rigcal-sim" / "control.sock"))
    with running(tmp_path, "swdt82") as daemon:
        assert run_apart("setup", "new", "S1", *where).returncode == 0
        (simulator,) = simulators_of(daemon.pid)
        os.kill(simulator, signal.SIGKILL)
        wait(lambda: "simulated_rig_ended" in run_apart("status", *where).stdout)
        status = run_apart("status", *where).stdout
        assert "plug, the adapter" not in status
        remedy = "next simulation: Stop the daemon, and start it again with a new simulated rig: `rigcal run --sim`."
        assert remedy in " ".join(status.split())
        refused = run_apart("session", "start", "--prism", "r", *where)
        assert (
            "the simulated rig has ended; stop the daemon, and start both again with `rigcal run --sim`"
            in refused.stderr
        )


def simulators_of(daemon: int) -> list[int]:
    """Processes of simulated rigs that a daemon has started."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == daemon and b"\0simulators\0" in (process / "cmdline").read_bytes():
                found.append(int(process.name))
    return found
