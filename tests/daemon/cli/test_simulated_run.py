"""`rigcal run --sim` without a configuration leaves one, for the commands that ask for it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.commands import answer_apart

DEADLINE_S = 120.0


@pytest.mark.parametrize("rig", ["swdt82", "ur10"])
@pytest.mark.long
def test_a_simulated_rig_leaves_a_configuration_for_commands_on_its_store(rig: str, tmp_path: Path) -> None:
    """Joints that ur10's file reads from nowhere have simulated channels, which the configuration knows too."""
    config = tmp_path / "rigcal-sim" / "rigcal.toml"
    with (tmp_path / "log").open("w") as log:
        command = [sys.executable, "-m", "daemon.cli.main", "run", "--sim", "--rig", rig, "--rate", "5"]
        daemon = subprocess.Popen(command, cwd=tmp_path, stdout=log, stderr=log)
    try:
        deadline = time.monotonic() + DEADLINE_S
        while not (config.exists() and (config.parent / "control.sock").exists()):
            assert daemon.poll() is None, (tmp_path / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert answer_apart("status", "--config", str(config))["mode"] == "simulated"
    finally:
        daemon.send_signal(signal.SIGINT)
        assert daemon.wait(timeout=60) == 0
    assert answer_apart("config", "check", str(config)) == {"rig": rig, "links": ["boom", "station"]}
    assert answer_apart("store", "check", "--config", str(config))
