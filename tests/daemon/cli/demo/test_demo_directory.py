"""A demonstration has its directory for itself, and its daemon ends with it."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from daemon.cli.main import main
from daemon.store.files import WriterLock
from tests.daemon.support.acquisition import wait_until


def processes_of(directory: Path) -> list[str]:
    """Command lines of all processes that name a directory."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            found.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return [line for line in found if str(directory) in line]


def test_a_demo_empties_no_directory_in_which_one_runs(tmp_path: Path) -> None:
    for name in ("rigcal.toml", "daemon.log", "rigcal.sqlite"):
        (tmp_path / name).write_text("of the demo that runs")
    lock = WriterLock(tmp_path / "rigcal.sqlite")
    try:
        said = CliRunner().invoke(main, ["demo", "--out", str(tmp_path)])
    finally:
        lock.release()
    assert said.exit_code == 2
    assert "a demo is running in" in said.output
    assert "wait for its end, or name a different directory with --out" in said.output
    assert (tmp_path / "rigcal.sqlite").exists()


@pytest.mark.slow
def test_a_demo_that_is_terminated_leaves_neither_daemon_nor_simulated_rig(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [sys.executable, "-m", "daemon.cli.main", "demo", "--out", str(out)]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: any("simulators" in line for line in processes_of(out)))
        demo.send_signal(signal.SIGTERM)
        assert demo.wait(60) == 128 + signal.SIGTERM
        assert processes_of(out) == []
    finally:
        demo.kill()
        demo.wait()
