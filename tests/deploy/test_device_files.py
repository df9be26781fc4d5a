"""The networkd, udev, sysusers and configuration files, each read by the program that will read it on the rig."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from daemon.config.config import read_config
from drivers.can.ports import CanLinkConfig
from tests.deploy.conftest import DEPLOY, private_namespaces, program, run

NETWORK = Path("etc/systemd/network")
RULES = Path("etc/udev/rules.d")


def networkd_complaints(root: Path) -> list[str]:
    """What systemd-networkd says of the files in `root`, started in namespaces of its own until it has read them."""
    prefix = private_namespaces()
    if os.geteuid() != 0:
        pytest.skip("systemd-networkd starts as root only, so 80-can0.network was NOT parsed")
    networkd = program("systemd-networkd", "systemd")
    script = f"""
        mkdir -p /etc/systemd/network
        mount -t tmpfs none /run
        mkdir -p /run/systemd/netif
        chown systemd-network: /run/systemd/netif
        mount --bind '{root / NETWORK}' /etc/systemd/network
        exec timeout 60 '{networkd}'
    """
    environment = os.environ | {"SYSTEMD_LOG_LEVEL": "debug", "SYSTEMD_LOG_TARGET": "console"}
    lines = []
    with subprocess.Popen(
        [*prefix, script], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if "Enumeration completed" in line:
                process.terminate()
    assert any("Enumeration completed" in line for line in lines), "".join(lines)
    return [line for line in lines if re.search(r"\.network:\d+:", line)]


def test_networkd_has_nothing_to_say_about_the_can_interface(installed: Path) -> None:
    assert networkd_complaints(installed) == []


def test_the_check_sees_a_wrong_bit_rate_and_a_misspelt_key(installed: Path) -> None:
    file = installed / NETWORK / "80-can0.network"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("250K", "fast").replace("ListenOnly", "LissenOnly"), encoding="utf-8")
    complaints = "\n".join(networkd_complaints(installed))
    assert "'fast'" in complaints
    assert "LissenOnly" in complaints


def test_the_can_interface_only_listens() -> None:
    assert re.search(r"(?m)^ListenOnly=yes$", (DEPLOY / "80-can0.network").read_text(encoding="utf-8"))


def udev_complaints(root: Path) -> list[str]:
    """What udev's rule parser says of the files in `root`: `udevadm verify` where there is one (systemd 254)."""
    udevadm = program("udevadm", "udev")
    rules = sorted((root / RULES).iterdir())
    if int(run(udevadm, "--version").stdout.split()[0]) >= 254:
        result = run(udevadm, "verify", "--no-summary", *rules)
        return result.stdout.splitlines()
    script = f"mount --bind '{root / RULES}' /etc/udev/rules.d; exec '{udevadm}' test /sys/class/mem/null"
    result = run(*private_namespaces(), f"mkdir -p /etc/udev/rules.d; {script}")
    for rule in rules:
        assert f"Reading rules file: /etc/udev/rules.d/{rule.name}" in result.stdout, result.stdout
    return [line for line in result.stdout.splitlines() if re.search(r"/etc/udev/rules\.d/[^:]*:\d+", line)]


def test_udev_has_nothing_to_say_about_the_station_rule(installed: Path) -> None:
    assert udev_complaints(installed) == []


def test_the_check_sees_a_misspelt_rule(installed: Path) -> None:
    file = installed / RULES / "99-rigcal-station.rules"
    file.write_text(file.read_text(encoding="utf-8").replace("SUBSYSTEM==", "SUBSISTEM=="), encoding="utf-8")
    assert "SUBSISTEM" in "\n".join(udev_complaints(installed))


def test_the_service_gets_a_user_that_may_open_serial_ports(tmp_path: Path) -> None:
    definitions = tmp_path / "usr/lib/sysusers.d"
    definitions.mkdir(parents=True)
    (tmp_path / "etc").mkdir()
    (definitions / "rigcal.conf").write_bytes((DEPLOY / "rigcal.sysusers").read_bytes())
    result = run(program("systemd-sysusers", "systemd"), f"--root={tmp_path}")
    assert result.returncode == 0, result.stdout
    user = next(
        line.split(":") for line in (tmp_path / "etc/passwd").read_text().splitlines() if line.startswith("rigcal:")
    )
    assert user[5] == "/var/lib/rigcal"
    assert user[6].endswith("nologin")
    groups = (tmp_path / "etc/group").read_text()
    assert re.search(r"(?m)^dialout:.*\brigcal\b", groups)
    # A process may give a file to groups that it is a member of alone: the daemon gives those who look their socket.
    assert re.search(rf"(?m)^{read_config(DEPLOY / 'rigcal.toml').read_group}:.*:rigcal$", groups)


def test_the_example_configuration_is_accepted_and_sends_nothing() -> None:
    config = read_config(DEPLOY / "rigcal.toml")
    assert [link.allow_transmit for link in config.can] == [False]


def test_the_example_configuration_opens_the_port_and_the_interface_that_are_set_up(installed: Path) -> None:
    config = read_config(installed / "etc/rigcal/rigcal.toml")
    rule = (installed / RULES / "99-rigcal-station.rules").read_text(encoding="utf-8")
    assert config.station[0].serial.path == "/dev/" + re.findall(r'SYMLINK\+="([^"]+)"', rule)[0]
    network = (installed / NETWORK / "80-can0.network").read_text(encoding="utf-8")
    assert config.can[0].channel == re.findall(r"(?m)^Name=(.+)$", network)[0]


def test_the_kernel_grants_the_receive_buffer_that_a_can_link_asks_for(installed: Path) -> None:
    asked = CanLinkConfig(name="boom", interface="socketcan", channel="can0").receive_buffer_bytes
    limits = (installed / "etc/sysctl.d/60-rigcal.conf").read_text(encoding="utf-8")
    assert int(re.findall(r"(?m)^net\.core\.rmem_max = (\d+)$", limits)[0]) >= asked
