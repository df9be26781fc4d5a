import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.host.systemd import Notifier


def test_states_reach_the_service_manager(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).send("READY=1", "STATUS=acquiring")
        assert manager.recv(100) == b"READY=1\nSTATUS=acquiring"


def test_abstract_sockets_are_reached() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0rigcal-test-{os.getpid()}")
        Notifier({"NOTIFY_SOCKET": f"@rigcal-test-{os.getpid()}"}).send("WATCHDOG=1")
        assert manager.recv(100) == b"WATCHDOG=1"


def test_outside_systemd_nothing_is_sent() -> None:
    notifier = Notifier({})
    notifier.send("READY=1")
    assert notifier.watchdog_s is None


def test_the_watchdog_interval_is_for_this_process_alone() -> None:
    mine = {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}
    assert Notifier(mine).watchdog_s == 30.0
    assert Notifier(mine | {"WATCHDOG_PID": "1"}).watchdog_s is None


def test_a_beat_is_sent_when_no_descriptor_is_left(tmp_path: Path) -> None:
    script = """
import os, resource
from daemon.host.systemd import Notifier
notifier = Notifier()
resource.setrlimit(resource.RLIMIT_NOFILE, (32, 32))
try:
    while True:
        os.open("/dev/null", os.O_RDONLY)
except OSError:
    notifier.send("WATCHDOG=1")
"""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        environ = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        subprocess.run([sys.executable, "-c", script], env=environ, check=True)
        assert manager.recv(100) == b"WATCHDOG=1"


def test_a_service_manager_that_is_gone_ends_no_daemon(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    for _ in range(3):
        notifier.send("WATCHDOG=1")
    assert caplog.text.count("the service manager cannot be reached") == 1
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        notifier.send("WATCHDOG=1")
        assert manager.recv(100) == b"WATCHDOG=1"


def test_a_start_that_takes_its_time_asks_the_service_manager_for_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.host.systemd.EXTEND_EVERY_S", 0.01)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        with notifier.extending("opening the store"):
            for _ in range(2):
                assert manager.recv(100) == b"EXTEND_TIMEOUT_USEC=60000000\nSTATUS=opening the store"
