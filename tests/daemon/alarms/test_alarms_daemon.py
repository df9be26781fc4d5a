"""A whole daemon tells what is wrong on its socket, in its store and in its log."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import pytest

from daemon.composition import live
from daemon.config.config import parse_config
from daemon.control.protocol import request
from daemon.rig_files import load_rig
from daemon.service import Daemon
from daemon.sessions.prisms.standstill_places import ELSEWHERE
from daemon.store import Store
from tests.daemon.acquisition.test_clock_watch import SetClock
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.daemon_process import DaemonProcess
from tests.daemon.support.idle_daemon import running as run_daemon
from tests.daemon.support.sessions import STEP_S
from tests.daemon.support.sessions import Rig as SessionRig
from tests.daemon.support.store import table

CONFIG = """rig = "swdt82"
state_directory = "."
[[can]]
channel = "rigcal-none"
[[station]]
serial.path = "no-such-port"
[jobs]
enabled = false
"""


@contextmanager
def running(directory: Path, clock: SetClock) -> Iterator[Path]:
    """A daemon without devices; its control socket."""
    config = parse_config(CONFIG, directory / "rigcal.toml")
    store = Store(config.store_path)
    daemon = Daemon(config, store, replace(live(config, load_rig("swdt82")), clock=clock))
    with run_daemon(daemon, store):
        yield config.socket_path


def active(socket: Path) -> dict[tuple[str, str], dict[str, Any]]:
    return {(a["kind"], a["subject"]): a for a in request(socket, "status")["alarms"]["active"]}


def test_links_that_cannot_be_opened_are_alarms_that_outlive_a_restart(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys = {("link_down", "boom"), ("link_down", "station")}
    with running(tmp_path, SetClock()) as socket:
        wait_until(lambda: set(active(socket)) == keys)
        since = {key: alarm["since_utc_ns"] for key, alarm in active(socket).items()}
        assert active(socket)["link_down", "boom"]["severity"] == "critical"
        assert active(socket)["link_down", "station"]["severity"] == "warning"
        channels = {c["name"]: c["status"] for c in request(socket, "status")["acquisition"]["channels"]}
        assert channels["theta1"] == "link_down"
        shown = rigcal("status", "--socket", str(socket)).stdout.splitlines()
        assert shown[2].startswith("alarms    CRITICAL link_down boom: ")
        listed = rigcal("alarms", "--socket", str(socket)).stdout
        assert "rigcal reopens the link by itself" in listed
    raised = [r for r in caplog.records if r.name == "daemon.alarms.board"]
    assert sorted(r.levelno for r in raised) == [logging.WARNING, logging.ERROR]
    caplog.clear()
    with running(tmp_path, SetClock()) as socket:
        wait_until(lambda: request(socket, "status")["alarms"]["looked_age_s"] < 1.0 and set(active(socket)) == keys)
        assert {key: alarm["since_utc_ns"] for key, alarm in active(socket).items()} == since
    assert not [r for r in caplog.records if r.name == "daemon.alarms.board"], "they were told already"
    assert len(table(tmp_path / "rigcal.sqlite", "alarms")) == 2


def test_a_clock_that_was_set_back_while_rigcal_did_not_run_is_an_event_and_alarms(tmp_path: Path) -> None:
    clock = SetClock()
    with running(tmp_path, clock):
        pass
    clock.ahead_s = -7200.0
    with running(tmp_path, clock) as socket:
        wait_until(lambda: {("clock_stepped", "clock"), ("clock_behind", "clock")} <= set(active(socket)))
        assert "by 7200.0 s while rigcal was not running" in active(socket)["clock_stepped", "clock"]["text"]
        clock.ahead_s = 0.0
        wait_until(lambda: ("clock_behind", "clock") not in active(socket))
    steps = [e["code"] for e in table(tmp_path / "rigcal.sqlite", "device_events") if e["kind"] == "clock_step"]
    assert steps == [pytest.approx(-7_200_000, abs=100), pytest.approx(7_200_000, abs=100)]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_an_error_has_ended_is_an_alarm(tmp_path: Path) -> None:
    def fail() -> NoReturn:
        raise ArithmeticError("a fault")

    before = threading.excepthook
    with running(tmp_path, SetClock()) as socket:
        wait_until(lambda: threading.excepthook != before)
        for name, ends in (("tip", fail), ("another", sys.exit)):
            thread = threading.Thread(target=ends, name=name)
            thread.start()
            thread.join()
        wait_until(lambda: ("thread_ended", "tip") in active(socket))
        assert active(socket)["thread_ended", "tip"]["text"] == "the thread tip has ended: ArithmeticError: a fault"
        assert ("thread_ended", "another") not in active(socket)
    assert threading.excepthook == before


@pytest.mark.long
def test_a_rig_that_falls_silent_raises_few_alarms_and_clears_them_when_it_speaks_again(tmp_path: Path) -> None:
    daemon = DaemonProcess(tmp_path, "--sim", "--rate", "2", "--seed", "3", jobs=False)
    try:
        daemon.wait("a fix", daemon.has_fix)
        daemon.wait("no alarm", lambda: not daemon.say("alarms.list")["active"])
        (simulator,) = children(daemon.process.pid)
        os.kill(simulator, signal.SIGSTOP)
        try:
            expected = {("link_silent", "boom"), ("station_silent", "station")}
            daemon.wait("the alarms", lambda: set(active(daemon.socket)) >= expected)
            told = daemon.say("status")["acquisition"]
            assert {c["status"] for c in told["channels"]} == {"silent"}
            assert all(c["value"] is None for c in told["channels"])
            assert told["stations"][0]["lock"] == "unknown"
            assert not [key for key in active(daemon.socket) if key[0] in {"joint_silent", "heartbeat_lost"}]
        finally:
            os.kill(simulator, signal.SIGCONT)
        daemon.wait("the end of the alarms", lambda: not set(active(daemon.socket)) & expected)
        cleared = rigcal("alarms", "--all", "--socket", str(daemon.socket))
        assert cleared.returncode == 0, cleared.stderr
        assert "link_silent boom" in cleared.stdout
    finally:
        assert daemon.stop() == 0, daemon.log_text()
    assert "ERROR daemon.alarms.board: alarm link_silent, boom" in daemon.log_text()


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()]


def rigcal(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-m", "daemon.cli.main", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )


def test_fixes_elsewhere_are_an_alarm_however_old_the_newest_fix_is_until_one_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = SessionRig(tmp_path / "sessions.sqlite")
    monkeypatch.setattr(rig.clock, "real_seconds", lambda seconds: seconds)  # fixes age as this clock goes
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    store = Store(config.store_path)
    daemon = Daemon(config, store, replace(live(config, load_rig("swdt82")), clock=SetClock()))
    monkeypatch.setattr(daemon, "_sessions", rig.keeper)
    newest = daemon._evidence()["newest_excluded"]
    rig.say("setup_new", id="S1")
    rig.say("start", prism="r")
    rig.live(3)
    place_mm = rig.target_mm
    rig.target_mm = (place_mm[0] + 200.0, *place_mm[1:])
    rig.live(STEP_S)
    rig.steps_of_fix = 10**6
    for _ in range(3):
        rig.live(12)
        assert str(newest()).startswith(ELSEWHERE)
    rig.steps_of_fix, rig.target_mm = 1, place_mm
    rig.live(1)
    assert newest() is None
    rig.store.close()
    daemon.close()
    store.close()
