"""The systemd unit, put through systemd-analyze in a root directory that holds it where it will be.

`systemd-analyze verify` looks the program of ExecStart up and complains when it is missing, so the root holds an
executable of that name; and it ends with status 0 on a misspelt key, so anything it prints is a failure.
"""

import shutil
from pathlib import Path

import pytest

from daemon.host import time_service
from daemon.host.time_service import CLOCK_SOCKET
from daemon.jobs.child import JOB_COMMAND
from daemon.jobs.job_processes import JOBS_SOCKET
from tests.deploy.conftest import DEPLOY, program, run

UNIT = Path("etc/systemd/system/rigcal.service")
UNITS = (
    "rigcal.service",
    "rigcal-jobs.socket",
    "rigcal-jobs@0.service",
    "system-rigcaljobs.slice",
    "rigcal-clock.socket",
    "rigcal-clock@0.service",
)


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
    for name in ("rigcal", "python"):
        executable = installed / "opt/rigcal/venv/bin" / name
        executable.parent.mkdir(parents=True, exist_ok=True)
        executable.write_text("#!/bin/sh\n", encoding="utf-8")
        executable.chmod(0o755)
    return installed


def verify(root: Path) -> str:
    result = run(program("systemd-analyze", "systemd"), "verify", "--man=no", f"--root={root}", *UNITS)
    return result.stdout + (f"\nexit status {result.returncode}" if result.returncode else "")


def test_systemd_has_nothing_to_say_about_the_units(rig_computer: Path) -> None:
    assert verify(rig_computer) == ""


def test_the_check_sees_a_misspelt_key(rig_computer: Path) -> None:
    unit = rig_computer / UNIT
    unit.write_text(unit.read_text(encoding="utf-8").replace("WatchdogSec=", "WatchDogSec="), encoding="utf-8")
    assert "WatchDogSec" in verify(rig_computer)


def test_the_check_sees_a_program_that_is_not_where_the_unit_says(rig_computer: Path) -> None:
    (rig_computer / "opt/rigcal/venv/bin/rigcal").unlink()
    assert "/opt/rigcal/venv/bin/rigcal is not executable" in verify(rig_computer)


@pytest.mark.parametrize(
    ("unit", "tenths"), [("rigcal.service", 15), ("rigcal-jobs@0.service", 5), ("rigcal-clock@0.service", 15)]
)
def test_the_services_are_exposed_little(installed: Path, unit: str, tenths: int) -> None:
    options = ("--no-pager", "--offline=true", f"--threshold={tenths}", f"--root={installed}")
    result = run(program("systemd-analyze", "systemd"), "security", *options, unit)
    assert result.returncode == 0, result.stdout


def test_the_check_sees_a_service_that_is_more_exposed(installed: Path) -> None:
    unit = installed / UNIT
    unit.write_text(unit.read_text(encoding="utf-8").replace("PrivateMounts=yes\n", ""), encoding="utf-8")
    options = ("--no-pager", "--offline=true", "--threshold=15", f"--root={installed}")
    assert run(program("systemd-analyze", "systemd"), "security", *options, "rigcal.service").returncode != 0


def test_jobs_are_a_unit_of_their_own_with_less_of_the_computer_than_acquisition() -> None:
    job, slice_ = settings(DEPLOY / "rigcal-jobs@.service"), settings(DEPLOY / "system-rigcaljobs.slice")
    service, listener = settings(DEPLOY / "rigcal.service"), settings(DEPLOY / "rigcal-jobs.socket")
    assert job["Slice"] == ["system-rigcaljobs.slice"]  # within system.slice, where rigcal.service is: weights compare
    assert int(slice_["CPUWeight"][0]) * 10 <= int(service["CPUWeight"][0])
    assert "MemoryMax" in slice_
    assert int(job["Nice"][0]) > 0
    assert f"{JOBS_SOCKET}={listener['ListenStream'][0]}" in service["Environment"]
    assert (listener["SocketUser"], listener["SocketMode"]) == (service["User"], ["0600"])
    assert job["ExecStart"][0].split()[-2:] == [*JOB_COMMAND[-2:]]
    for both in ("User", "Group", "UMask", "StateDirectory", "CacheDirectory"):
        assert job[both] == service[both]


def test_a_shutdown_stops_the_daemon_before_its_job_so_that_the_job_is_interrupted_and_does_not_fail() -> None:
    job = settings(DEPLOY / "rigcal-jobs@.service")
    assert job["BindsTo"] == ["rigcal.service"]
    assert job["Before"] == ["rigcal.service"], "units stop in the reverse order of their start"
    assert "After" not in job


def test_the_clock_is_read_by_a_unit_that_cannot_set_it() -> None:
    service, reader = settings(DEPLOY / "rigcal.service"), settings(DEPLOY / "rigcal-clock@.service")
    (path,) = settings(DEPLOY / "rigcal-clock.socket")["ListenStream"]
    assert f"{CLOCK_SOCKET}={path}" in service["Environment"]
    assert reader["ExecStart"][0].split()[-2:] == ["-m", time_service.__name__]
    assert reader["CapabilityBoundingSet"] == [""]
    assert reader["NoNewPrivileges"] == ["yes"]


def test_network_conf_opens_loopback(rig_computer: Path) -> None:
    drop_in = rig_computer / "etc/systemd/system/rigcal.service.d/network.conf"
    drop_in.parent.mkdir()
    shutil.copy(DEPLOY / "network.conf", drop_in)
    assert verify(rig_computer) == ""
    families = settings(DEPLOY / "network.conf")["RestrictAddressFamilies"]
    assert families == ["AF_INET AF_INET6"]  # added to those of the unit, which has no network
    assert "INET" not in settings(DEPLOY / "rigcal.service")["RestrictAddressFamilies"][0]


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
