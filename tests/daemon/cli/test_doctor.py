"""`rigcal doctor`: what it looks at, and what it says to type."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from daemon.cli.diagnosis import Finding, can_interface, daemon_state
from daemon.cli.main import main
from daemon.config.sections import CanSection
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import idle_daemon

SECTION = CanSection(channel="can0", bitrate=250_000)
CONFIG = (
    'rig = "swdt82"\nstate_directory = "state"\n[[can]]\nchannel = "rigcal-none0"\n[[station]]\nserial.path = "{}"\n'
)


def details(state: str = "ERROR-ACTIVE", rate: int = 250_000, *modes: str, flags: tuple[str, ...] = ("UP",)) -> Any:
    """What `ip -json -details link show` prints of an interface (iproute2 6.1)."""
    data = {"state": state, "ctrlmode": list(modes), "bittiming": {"bitrate": rate}}
    return {"flags": ["NOARP", *flags], "linkinfo": {"info_kind": "can", "info_data": data}}


@pytest.mark.parametrize(
    ("told", "section", "state", "remedy"),
    [
        (details("ERROR-ACTIVE", 250_000, "LISTEN-ONLY"), SECTION, "good", ""),
        (details("ERROR-ACTIVE", 250_000), SECTION, "warning", "ListenOnly=yes"),
        (details("ERROR-ACTIVE", 500_000, "LISTEN-ONLY"), SECTION, "fault", "BitRate"),
        (details("BUS-OFF", 250_000, "LISTEN-ONLY"), SECTION, "fault", "termination"),
        (details(flags=()), SECTION, "fault", "ip link set can0 up type can bitrate 250000 listen-only on"),
        (
            details("ERROR-ACTIVE", 250_000, "LISTEN-ONLY"),
            CanSection(channel="can0", allow_transmit=True),
            "fault",
            "=no",
        ),
        ({"flags": ["UP"], "linkinfo": {"info_kind": "vcan"}}, SECTION, "good", ""),
        (None, SECTION, "unknown", "iproute2"),
    ],
)
def test_an_interface_is_judged_by_what_the_kernel_tells(
    told: Any, section: CanSection, state: str, remedy: str, tmp_path: Path
) -> None:
    found = can_interface(section, told, tmp_path)
    assert found.state == state, found
    assert remedy in found.remedy


def examine(*options: str) -> tuple[Result, dict[str, dict[str, str]]]:
    done = CliRunner().invoke(main, ["doctor", *options, "--json"])
    return done, {finding["subject"]: finding for finding in json.loads(done.stdout)["findings"]}


def test_without_a_daemon_each_fault_says_what_to_type(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text(CONFIG.format(tmp_path / "no-station"), encoding="utf-8")
    done, findings = examine("--config", str(config))
    assert done.exit_code == 1
    assert findings["configuration"]["state"] == "good"
    assert "no such interface" in findings["rigcal-none0"]["text"]
    assert "udevadm" in findings["station"]["remedy"]
    assert "systemctl status rigcal" in findings["daemon"]["remedy"]
    assert {"clock", "disk", "kernels"} <= set(findings)
    assert all(finding["remedy"] for finding in findings.values() if finding["state"] != "good")
    shown = CliRunner().invoke(main, ["doctor", "--config", str(config)])
    assert shown.exit_code == 1
    assert shown.stdout.count("-> ") == sum(bool(finding["remedy"]) for finding in findings.values())


def test_the_port_of_an_slcan_adapter_is_looked_at_as_that_of_a_station(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    port = tmp_path / "adapter"
    config.write_text(f'rig = "swdt82"\n[[can]]\ninterface = "slcan"\nchannel = "{port}@115200"\n', encoding="utf-8")
    _, findings = examine("--config", str(config))
    assert findings["boom"]["state"] == "fault"
    assert f"{port} does not exist" in findings["boom"]["text"]
    assert findings["boom"]["remedy"] == "plug it in, or correct [[can]] channel"
    port.touch()
    _, findings = examine("--config", str(config))
    assert f"{port} is not a serial port" in findings["boom"]["text"]
    port.unlink()
    controller, device = os.openpty()
    port.symlink_to(os.ttyname(device))
    _, findings = examine("--config", str(config))
    assert findings["boom"]["state"] == "good"
    os.close(controller)
    os.close(device)


def test_backups_go_where_the_daemon_may_write(tmp_path: Path) -> None:
    config, place = tmp_path / "rigcal.toml", tmp_path / "backups"
    config.write_text(CONFIG.format("none"), encoding="utf-8")
    (tmp_path / "state").mkdir()
    assert "none are made" in examine("--config", str(config))[1]["backups"]["text"]
    config.write_text(f"{CONFIG.format('none')}[store]\nbackup_directory = 'backups'\n", encoding="utf-8")
    missing = examine("--config", str(config))[1]["backups"]
    assert missing["state"] == "warning"
    assert f"install -d -o rigcal -g rigcal -m 0750 {place}" in missing["remedy"]
    place.mkdir()
    assert examine("--config", str(config))[1]["backups"]["state"] == "good"
    if os.geteuid() == 0:
        os.chown(place, 65534, -1)
        assert "does not belong to the owner" in examine("--config", str(config))[1]["backups"]["text"]


def test_a_wrong_configuration_is_the_first_finding(tmp_path: Path) -> None:
    config = tmp_path / "rigcal.toml"
    config.write_text('rig = "swdt82"\ncolour = "red"\n', encoding="utf-8")
    done, findings = examine("--config", str(config), "--socket", str(tmp_path / "none"))
    assert done.exit_code == 1
    assert next(iter(findings)) == "configuration"
    assert "unknown key" in findings["configuration"]["text"]
    config.write_text('rig = "digger"\n', encoding="utf-8")
    _, findings = examine("--config", str(config), "--socket", str(tmp_path / "none"))
    assert f"{config}: rig: digger: neither a shipped rig (" in findings["configuration"]["text"]


def test_a_busy_computer_is_told_beside_what_looks_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (1e3, 0.0, 0.0))
    _, findings = examine("--socket", str(tmp_path / "none"))
    assert findings["processor"]["state"] == "warning"
    assert "1000 processes compete for" in findings["processor"]["text"]
    assert "--rate" in findings["processor"]["remedy"]
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    assert examine("--socket", str(tmp_path / "none"))[1]["processor"]["state"] == "good"


def test_a_running_daemon_tells_of_store_and_channels(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        # On a busy disk a write may take seconds, which doctor reports
        wait_until(lambda: examine("--socket", str(config.socket_path))[1]["store"]["state"] == "good")
        _, findings = examine("--socket", str(config.socket_path))
    assert findings["daemon"]["state"] == "good"
    assert "theta1" in findings["joints"]["text"]


def told(*, alarms: Sequence[Mapping[str, str]] = (), **acquisition: Any) -> list[Finding]:
    """What doctor finds of a daemon with this status."""
    status = {
        "version": "0.1.0",
        "mode": "live",
        "store": "/x",
        "store_health": {"state": "ok", "text": ""},
        "alarms": {"active": alarms},
        "acquisition": {
            "links": [],
            "channels": [],
            "stations": [],
            "gap_counts": [],
            "error": None,
            "is_write_hung": False,
            **acquisition,
        },
    }
    return list(daemon_state(status, "0.2.0"))


def silences(channels: int, reason: str = "silent") -> list[dict[str, Any]]:
    return [{"channel": f"theta{n}", "reason": reason, "count": 40 - n, "missed": 0} for n in range(1, channels + 1)]


def only(findings: Sequence[Finding], subject: str) -> Finding:
    (found,) = (finding for finding in findings if finding.subject == subject)
    return found


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))


@pytest.mark.usefixtures("idle")
def test_channels_that_fall_silent_again_and_again_are_one_finding() -> None:
    findings = told(gap_counts=silences(17))
    found = only(findings, "timeouts")
    assert found.text.endswith(
        "theta1 39 times, theta2 38 times, theta3 37 times, theta4 36 times, theta5 35 times, and 12 more"
    )
    assert found.remedy.startswith("check their cables; if a device is only slow")
    assert "timeout_s" in found.remedy
    assert only(findings, "daemon").remedy == "`systemctl restart rigcal`"
    assert only(told(), "timeouts").state == "good"


@pytest.mark.usefixtures("idle")
def test_captures_that_were_read_late_name_the_processor_before_the_rig_file() -> None:
    found = only(told(gap_counts=silences(2) + silences(1, "time_doubtful")), "timeouts")
    assert found.remedy.startswith("an overloaded processor is the likely cause: relieve it")


def test_a_busy_processor_is_named_before_the_rig_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (1e3, 0.0, 0.0))
    assert only(told(gap_counts=silences(1)), "timeouts").remedy.startswith("an overloaded processor")


@pytest.mark.parametrize(
    ("status", "remedy"),
    [("link_down", "the plug, the cable"), ("silent", "power and cable"), ("not_locked", "aim it at the prism")],
)
def test_the_remedy_for_a_station_follows_its_state(status: str, remedy: str) -> None:
    station = {"name": "station", "age_s": 12.0, "status": status, "sentence": status, "is_silent": True}
    found = only(told(stations=[station]), "station station")
    assert (found.state, remedy in found.remedy) == ("warning", True)
    assert ("aim" in found.remedy) == (status == "not_locked")


def test_a_station_that_is_not_level_is_to_be_levelled() -> None:
    station = {"name": "station", "age_s": 1.0, "status": "not_available", "sentence": "not level", "tilt_ok": False}
    assert only(told(stations=[station]), "station station").remedy.startswith("level it")


def test_alarms_that_only_warn_are_no_fault() -> None:
    critical = {"kind": "link_down", "subject": "boom", "severity": "critical"}
    warning = {"kind": "disk_low", "subject": "disk", "severity": "warning"}
    shown = [(f.state, f.text) for f in told(alarms=[critical, warning]) if f.subject == "alarms"]
    assert shown == [("fault", "link_down boom"), ("warning", "disk_low disk")]
    assert [f.state for f in told(alarms=[warning]) if f.subject == "alarms"] == ["warning"]


@pytest.mark.parametrize("hindrance", [{"error": "/x: locked by another program"}, {"is_write_hung": True}])
def test_while_nothing_can_be_stored_the_store_is_at_fault_and_no_device_or_link(hindrance: dict[str, Any]) -> None:
    link = {"name": "boom", "up": True, "captures_per_s": 0.0, "dropped": 0, "reason": ""}
    late = {"name": "theta1", "kind": "joint", "status": "silent", "is_silent": False, "age_s": 9.0}
    never = {**late, "name": "theta3", "age_s": None}
    station = {**late, "name": "ts1", "sentence": "late, nothing decoded for 9 s"}
    findings = told(links=[link], channels=[late, never], stations=[station], **hindrance)
    assert [f.subject for f in findings if f.state == "fault"] == ["store", "joints"]
    assert only(findings, "store").text.startswith("nothing can be stored: ")
    assert only(findings, "link boom").state == "unknown"
    assert only(findings, "joints").text == "late, not yet decoded: theta1, theta3"
    for subject in ("link boom", "joints", "station ts1"):
        assert "cable" not in only(findings, subject).remedy
