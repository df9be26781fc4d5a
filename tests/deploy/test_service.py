"""The systemd unit, put through systemd-analyze in a root directory that holds it where it will be.

`systemd-analyze verify` looks the program of ExecStart up and complains when it is missing, so the root holds an
executable of that name; and it ends with status 0 on a misspelt key, so anything it prints is a failure.
"""

import shutil
from pathlib import Path

import pytest

from tests.deploy.conftest import DEPLOY, program, run

UNIT = Path("etc/systemd/system/rigcal.service")


def settings(unit: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in unit.read_text(encoding="utf-8").splitlines():
        key, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            found.setdefault(key, []).append(value)
    return found


@pytest.fixture
def rig_computer(installed: Path) -> Path:
    """The installed files beside systemd's own units and an executable in the program's place."""
    system_units = next(
        path for path in (Path("/usr/lib/systemd/system"), Path("/lib/systemd/system")) if path.exists()
    )
    shutil.copytree(system_units, installed / "usr/lib/systemd/system", symlinks=True)
    executable = installed / "opt/rigcal/venv/bin/rigcal"
    executable.parent.mkdir(parents=True)
    executable.write_text("#!/bin/sh\n", encoding="utf-8")
    executable.chmod(0o755)
    return installed


def verify(root: Path) -> str:
    result = run(program("systemd-analyze", "systemd"), "verify", "--man=no", f"--root={root}", "rigcal.service")
    return result.stdout + (f"\nexit status {result.returncode}" if result.returncode else "")


def test_systemd_has_nothing_to_say_about_the_unit(rig_computer: Path) -> None:
    assert verify(rig_computer) == ""


def test_the_check_sees_a_misspelt_key(rig_computer: Path) -> None:
    unit = rig_computer / UNIT
    unit.write_text(unit.read_text(encoding="utf-8").replace("WatchdogSec=", "WatchDogSec="), encoding="utf-8")
    assert "WatchDogSec" in verify(rig_computer)


def test_the_check_sees_a_program_that_is_not_where_the_unit_says(rig_computer: Path) -> None:
    (rig_computer / "opt/rigcal/venv/bin/rigcal").unlink()
    assert "/opt/rigcal/venv/bin/rigcal is not executable" in verify(rig_computer)


def test_the_service_is_exposed_little() -> None:
    result = run(
        program("systemd-analyze", "systemd"),
        "security",
        "--no-pager",
        "--offline=true",
        "--threshold=25",
        DEPLOY / "rigcal.service",
    )
    assert result.returncode == 0, result.stdout


def test_a_failing_service_is_restarted_for_ever() -> None:
    unit = settings(DEPLOY / "rigcal.service")
    assert unit["Restart"] == ["on-failure"]
    assert unit["StartLimitIntervalSec"] == ["0"]
    assert unit["Type"] == ["notify"]
    assert "WatchdogSec" in unit


def test_the_unit_reads_the_configuration_that_is_installed(installed: Path) -> None:
    command = settings(installed / UNIT)["ExecStart"][0].split()
    assert (installed / command[command.index("--config") + 1].lstrip("/")).is_file()


def test_members_of_the_reading_group_reach_their_socket_and_no_one_lists_the_store() -> None:
    unit = settings(DEPLOY / "rigcal.service")
    assert unit["RuntimeDirectoryMode"] == ["0755"]  # the sockets in it have modes of their own
    assert unit["StateDirectoryMode"] == ["0750"]


def test_every_serial_driver_that_the_unit_allows_is_loaded_before_it(installed: Path) -> None:
    # ttyS is built into the kernel.
    driver_of = {"char-ttyS": None, "char-ttyUSB": "usbserial", "char-ttyACM": "cdc-acm"}
    loaded = (installed / "etc/modules-load.d/rigcal.conf").read_text(encoding="utf-8").splitlines()
    for device in settings(installed / UNIT)["DeviceAllow"]:
        driver = driver_of[device.split()[0]]
        assert driver is None or driver in loaded
