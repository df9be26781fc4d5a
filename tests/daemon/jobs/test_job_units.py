"""Jobs that systemd starts for a connection; its own program for trying such services stands in for the manager."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from daemon.jobs.child import JOB_COMMAND, JobChild
from daemon.jobs.order import Order, Outcome, Started
from tests.daemon.support.jobs import DEADLINE_S, JobRig, is_gone

Listen = Callable[[Sequence[str]], Path]


@pytest.fixture
def listen(tmp_path: Path) -> Iterator[Listen]:
    """Starts what listens at a socket and runs a command for each connection."""
    program = shutil.which("systemd-socket-activate")
    if program is None:
        pytest.skip("systemd-socket-activate is not installed (package systemd), so jobs as units were NOT tried")
    listeners: list[subprocess.Popen[bytes]] = []

    def start(command: Sequence[str]) -> Path:
        path = tmp_path / "jobs.sock"
        with (tmp_path / "journal").open("wb") as journal:
            options = ["--accept", "--inetd", f"--listen={path}", f"--setenv=PYTHONPATH={Path.cwd()}"]
            listeners.append(subprocess.Popen([program, *options, *command], stderr=journal))
        deadline = time.monotonic() + DEADLINE_S
        while not path.exists():
            assert listeners[-1].poll() is None, (tmp_path / "journal").read_text(encoding="utf-8")
            assert time.monotonic() < deadline
            time.sleep(0.01)
        return path

    yield start
    for listener in listeners:
        listener.terminate()
        listener.wait()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[JobRig]:
    rig = JobRig(tmp_path)
    yield rig
    rig.close()


def test_jobs_run_as_units_to_their_results(rig: JobRig, listen: Listen) -> None:
    rig.session("a")
    rig.start(jobs_socket=listen(rig.scripted))
    rig.wait_for("done", "done", "done", "done")


def test_a_unit_that_hears_nothing_is_ended_when_its_job_is_cancelled(rig: JobRig, listen: Listen) -> None:
    rig.session("a")
    rig.plan(gap="deaf")
    runner = rig.start(jobs_socket=listen(rig.scripted))
    rig.wait((rig.directory / "child").exists)
    pid = rig.running(1)["pid"]
    assert not is_gone(pid)
    runner.cancel_command({"id": 1})
    rig.wait_for("cancelled", "cancelled", "cancelled", "cancelled")
    assert is_gone(pid)
    os.kill(int((rig.directory / "child").read_text()), 9)  # systemd would have ended it with its unit


@pytest.mark.parametrize("end", ["mute", "killed"])
def test_a_unit_that_ends_without_a_result_fails_its_job_and_names_the_journal(
    rig: JobRig, listen: Listen, end: str
) -> None:
    rig.session("a")
    rig.plan(gap=end)
    rig.start(jobs_socket=listen(rig.scripted))
    rig.wait_for("failed", "cancelled", "cancelled", "cancelled")
    assert "journalctl -u 'rigcal-jobs@*'" in rig.jobs()[0]["error"]


def test_the_process_of_a_job_speaks_through_a_connection(tmp_path: Path, listen: Listen) -> None:
    order = Order("no such kind", 1, str(tmp_path / "rigcal.sqlite"), "models", (), 0)
    assert JOB_COMMAND[0] == sys.executable
    with JobChild(order, jobs_socket=str(listen(JOB_COMMAND))) as child:
        started, message = child.next_message(60.0), child.next_message(60.0)
        assert started == Started(child.pid)
    assert isinstance(message, Outcome)
    assert "no such kind" in str(message.error)
    assert is_gone(child.pid)
    assert "KeyError" in (tmp_path / "journal").read_text(encoding="utf-8")


def test_where_nothing_listens_a_job_is_a_child_and_the_log_says_so(
    rig: JobRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.session("a")
    with caplog.at_level(logging.WARNING):
        rig.start(jobs_socket=rig.directory / "none.sock")
        rig.wait_for("done", "done", "done", "done")
    assert any("systemctl start rigcal-jobs.socket" in record.getMessage() for record in caplog.records)
