"""Jobs of the whole daemon, killed as a power cut would."""

import os
import sqlite3
import time
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.support.daemon_process import DaemonProcess
from tests.daemon.support.jobs import JobRig, is_gone

pytestmark = pytest.mark.long

SIM = ("--sim", "--rate", "25", "--seed", "3")
POSES = 1500  # identification takes far longer than an orphan is given to end


def first_job(directory: Path) -> dict[str, Any]:
    store = sqlite3.connect(f"file:{directory / 'rigcal.sqlite'}?mode=ro", uri=True)
    try:
        store.row_factory = sqlite3.Row
        rows = store.execute("SELECT state, pid, attempts, error FROM jobs ORDER BY id").fetchall()
        return dict(rows[0]) if rows else {"state": None, "pid": None, "attempts": 0, "error": None}
    finally:
        store.close()


def runs(directory: Path, attempt: int) -> bool:
    job = first_job(directory)
    return job["state"] == "running" and job["pid"] is not None and job["attempts"] == attempt


def test_a_killed_daemons_job_ends_with_it_and_runs_again_in_the_next(tmp_path: Path) -> None:
    rig = JobRig(tmp_path)
    rig.measured("a", POSES, prisms=["r"])
    rig.close()
    daemon = DaemonProcess(tmp_path, *SIM)
    try:
        daemon.wait("the job", lambda: runs(tmp_path, 1))
    finally:
        daemon.kill()
    orphan = first_job(tmp_path)["pid"]
    deadline = time.monotonic() + 30.0
    while not is_gone(orphan):
        assert time.monotonic() < deadline, "the orphan lives on"
        time.sleep(0.02)
    assert first_job(tmp_path)["state"] == "running", "nobody could write down how it ended"

    again = DaemonProcess(tmp_path, *SIM)
    try:
        again.wait("the job to run again", lambda: runs(tmp_path, 2))
        assert first_job(tmp_path)["error"] is None
        pid = first_job(tmp_path)["pid"]
        os.kill(pid, 0)
    finally:
        assert again.stop() == 0, again.log_text()
    assert first_job(tmp_path) == {
        "state": "interrupted",
        "pid": None,
        "attempts": 1,  # the kill; an orderly stop is none
        "error": "the daemon was stopped",
    }
    assert is_gone(pid)
    assert "queued again after an interruption" in again.log_text()
