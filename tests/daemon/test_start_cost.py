"""What a start of the service costs, and which libraries acquisition carries along."""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

CONFIG = """rig = "swdt82"
state_directory = "."

[[can]]
channel = "can-missing"

[[station]]
serial.path = "/dev/rigcal-missing"
"""
MOST_CPU_S = 3.0
# Not pandas: sqlite-utils imports it where it is installed, and it is not on a rig.
MATHEMATICS = {"numba", "llvmlite", "scipy", "lightgbm", "matplotlib"}
READY_S = 120.0


@pytest.fixture
def service(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The daemon as systemd starts it, once it has said that it is ready; its devices are missing."""
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG, encoding="utf-8")
    address = tmp_path / "notify"
    command = [sys.executable, "-m", "daemon.cli.main", "run", "--config", str(config)]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified, (tmp_path / "log").open("wb") as log:
        notified.bind(str(address))
        notified.settimeout(READY_S)
        process = subprocess.Popen(command, stderr=log, stdout=log, env=os.environ | {"NOTIFY_SOCKET": str(address)})
        try:
            while b"READY=1" not in notified.recv(4096):
                pass
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0, (tmp_path / "log").read_text(encoding="utf-8")


def cpu_s(pid: int) -> float:
    """User and system time of a process and of the children that it has waited for."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return sum(int(field) for field in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def test_the_service_is_ready_within_three_seconds_of_cpu_and_without_mathematics(
    service: subprocess.Popen[bytes],
) -> None:
    assert cpu_s(service.pid) <= MOST_CPU_S
    # Each of these brings compiled libraries, which the kernel lists for a process that runs.
    mapped = Path(f"/proc/{service.pid}/maps").read_text(encoding="utf-8")
    packages = set(re.findall(r"/site-packages/(\w+)", mapped))
    assert "numpy" in packages, "the list is not what this test takes it for"
    assert packages.isdisjoint(MATHEMATICS), packages & MATHEMATICS
