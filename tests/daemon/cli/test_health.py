"""`rigcal health` tells a monitoring system by its exit status how things are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from daemon.cli.commands.health import HELD_UP_S, findings_of
from daemon.cli.main import main
from daemon.control.protocol import request
from tests.daemon.acquisition.test_clock_watch import SetClock
from tests.daemon.alarms.test_alarms_daemon import running
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.idle_daemon import idle_daemon


def health(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["health", *arguments])


def test_a_daemon_without_alarms_is_good(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        told = health("--socket", str(config.socket_path))
    assert (told.exit_code, told.stdout) == (0, "OK: all is well\n")


def test_a_bus_that_is_not_there_is_critical_with_a_line_and_a_remedy(tmp_path: Path) -> None:
    with running(tmp_path, SetClock()) as socket:
        wait_until(lambda: len(request(socket, "status")["alarms"]["active"]) == 2)
        told = health("--socket", str(socket))
        as_json = json.loads(health("--socket", str(socket), "--json").stdout)
    assert told.exit_code == 2
    first, second, third = told.stdout.splitlines()
    assert first == "CRITICAL: 2 findings"
    assert second.startswith("critical: boom: ")
    assert second.endswith("Check the plug, the adapter and its power. rigcal reopens the link by itself.")
    assert third.startswith("warning: station: ")
    assert (as_json["status"], as_json["exit_status"]) == ("CRITICAL", 2)
    assert [finding["kind"] for finding in as_json["findings"]] == ["link_down", "link_down"]


def test_no_daemon_wrong_use_and_a_wrong_configuration_are_unknown_and_not_critical(tmp_path: Path) -> None:
    told = health("--socket", str(tmp_path / "control.sock"))
    assert told.exit_code == 3
    assert "no daemon is listening" in told.stdout
    assert health("--no-such-option").exit_code == 3
    assert health("--config", str(tmp_path / "rigcal.toml")).exit_code == 3


def test_warnings_alone_are_a_warning_and_a_daemon_that_is_held_up_is_critical() -> None:
    def status(age_s: float, **unreadable: str) -> dict[str, Any]:
        alarm = {"severity": "warning", "kind": "k", "subject": "s", "text": "t", "remedy": "R.", "age_s": 1.0}
        return {"alarms": {"active": [alarm], "looked_age_s": age_s}, "unreadable": unreadable}

    def kinds(told: dict[str, Any]) -> list[tuple[str, str]]:
        return [(finding["severity"], finding["kind"]) for finding in findings_of(told)]

    assert kinds(status(1.0)) == [("warning", "k")]
    assert kinds(status(2 * HELD_UP_S)) == [("critical", "held_up"), ("warning", "k")]
    assert kinds(status(1.0, jobs="malformed")) == [("critical", "unreadable"), ("warning", "k")]
