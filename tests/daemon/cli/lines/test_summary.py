"""The state on one screen, the next step, jobs in words, and the live watch."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from daemon.cli.lines.jobs import job_lines, outcome, percent
from daemon.cli.lines.summary import LINES, state_sentence, summary
from daemon.cli.main import main
from daemon.next_step import next_line
from tests.daemon.support.idle_daemon import idle_daemon

TERMINAL = (100, 24)


def alarm(number: int, severity: str = "critical") -> dict[str, Any]:
    return {
        "severity": severity,
        "kind": "joint_silent",
        "subject": f"theta{number}",
        "text": f"theta{number} is no longer received (last: ok), and this is a long text that is wrapped",
        "remedy": "Check the encoder's power and cable; without this joint no fix can be used.",
        "age_s": 40.0,
        "since_utc_ns": 1_700_000_000_000_000_000,
    }


def session(**changes: Any) -> dict[str, Any]:
    return {
        "id": "s001-r",
        "kind": "static_poses",
        "prism": "r",
        "poses": 4,
        "observations": 40,
        "setup_moved": False,
        "control_shots": [{"point": "cp1", "phase": "start", "misclosure_mm": None}],
        "excluded": {f"reason {n}, which takes its place on a line of the screen": 50 - n for n in range(12)},
        **changes,
    }


def status(**changes: Any) -> dict[str, Any]:
    channels = [
        {
            "name": f"theta{n}",
            "unit": "deg",
            "kind": "joint",
            "status": "ok",
            "value": 12.5,
            "age_s": 0.1,
            "is_silent": False,
            "link": "boom",
        }
        for n in range(9)
    ]
    return {
        "rig": "swdt82",
        "mode": "live",
        "version": "0.2.0",
        "store": "/var/lib/rigcal/rigcal.sqlite",
        "alarms": {"active": [], "looked_age_s": 0.5},
        "notices": [],
        "store_health": {"state": "ok", "text": ""},
        "unreadable": {},
        "acquisition": {
            "links": [{"name": "boom", "up": True, "captures_per_s": 800.0, "dropped": 0, "reason": ""}],
            "channels": channels,
            "stations": [{"name": "station", "sentence": "locked, ok, 0 s ago", "fixes": 12}],
            "gaps": [],
            "decoding": [],
            "is_behind": False,
        },
        "session": None,
        "guide": None,
        "setup": {"id": "S1", "state": "ok"},
        "jobs": [],
        "models": {"live": None, "candidate": None},
        "gap": None,
        **changes,
    }


WORST = status(
    alarms={"active": [alarm(n) for n in range(9)], "looked_age_s": 0.5},
    session=session(),
    jobs=[
        {"id": n, "kind": "gap", "session_id": "s", "state": "queued", "error": None, "progress": 0.0, "message": ""}
        for n in range(8)
    ],
)


@pytest.mark.parametrize("told", [status(), status(session=session()), WORST], ids=["idle", "session", "worst"])
def test_the_state_fits_a_terminal_of_24_lines(told: dict[str, Any]) -> None:
    lines = summary(told, TERMINAL[0])
    assert len(lines) <= LINES == TERMINAL[1] - 1
    assert max(len(line.text) for line in lines) <= TERMINAL[0]
    assert lines[0].text.startswith("rig       swdt82 (live)")
    assert lines[1].text.startswith("state     ")
    assert any(line.text.startswith("next      ") for line in lines)


def screen(told: dict[str, Any]) -> str:
    lines = summary(told, TERMINAL[0])
    assert len(lines) <= LINES
    return "\n".join(line.text for line in lines)


def acquired(**changes: Any) -> dict[str, Any]:
    return {**status()["acquisition"], **changes}


def gap(reason: str, number: int = 0) -> dict[str, Any]:
    return {"channel": f"theta{number}", "reason": reason, "start_utc_ns": 0, "age_s": 41.0}


def failing(number: int, lately: int = 0) -> dict[str, Any]:
    reason = "the frame has 3 bytes, and the value that is looked for in it needs 4 of them"
    return {"device": f"theta{number}", "count": 70, "reason": reason, "reason_count": 70, "lately": lately}


def test_what_does_not_fit_is_counted_with_the_command_that_shows_it() -> None:
    text = screen(WORST)
    told = text.count("CRITICAL joint_silent")
    assert told >= 5
    assert f"and {9 - told} more: `rigcal alarms` shows all" in text
    assert "... 10 more lines: `rigcal status --all` shows them" in text


def test_open_gaps_follow_the_alarms_however_many_these_are() -> None:
    text = screen(WORST | {"acquisition": acquired(gaps=[gap("silent", 3), gap("link_down", 4)])})
    assert text.count("CRITICAL joint_silent") >= 4
    _, after = text.split("more: `rigcal alarms` shows all\n")
    first, second, *_ = after.splitlines()
    assert first == "gaps      silent for 41 s: theta3"
    assert second == "          link down for 41 s: theta4"


def test_alarms_are_told_however_many_gaps_are_open() -> None:
    text = screen(WORST | {"acquisition": acquired(gaps=[gap(f"reason_{n}") for n in range(30)])})
    assert text.count("CRITICAL joint_silent") >= 4
    assert text.count(" for 41 s: theta0") >= 3
    left = 30 - text.count(" for 41 s: theta0")
    number = int(re.findall(r"\.\.\. (\d+) more lines", text)[0])
    assert number > left, "links, channels and the rest are left out as well"


def test_failed_decodes_and_jobs_push_nothing_out() -> None:
    decoding = [failing(n, lately=n) for n in range(9)]
    told = status(acquisition=acquired(decoding=decoding, gaps=[gap("silent")]), session=session(), jobs=WORST["jobs"])
    text = screen(told)
    for label in ("gaps", "links", "channels", "station", "session", "jobs", "models"):
        assert f"\n{label:10}" in text
    assert "theta8 could not be decoded (8 in the last minute)" in text, "what fails now comes first"
    assert "and 7 more: `rigcal status --all` shows all" in text
    assert "and 5 more: `rigcal jobs list` shows all" in text
    assert "more lines" not in text


def test_a_joint_whose_readings_wait_to_be_decoded_is_late_and_not_silent() -> None:
    joints = [dict(joint, status="silent", age_s=9.0) for joint in acquired()["channels"]]
    assert "late, not yet decoded: theta0" in screen(status(acquisition=acquired(channels=joints)))
    text = screen(status(acquisition=acquired(channels=[dict(joint, is_silent=True) for joint in joints])))
    assert "silent: theta0" in text


def test_watch_tells_of_an_alarm_on_the_smallest_terminal_and_calls_late_joints_late() -> None:
    told = status(alarms=WORST["alarms"])
    lines = [line.text for line in summary(told, 60, 6, with_joints=True)]
    assert any("CRITICAL joint_silent theta0" in line for line in lines[:6])
    order = [line.split()[0] for line in lines if not line.startswith(" ")]
    assert order.index("alarms") < order.index("joints") < order.index("next")
    joints = [dict(joint, status="silent", value=None) for joint in acquired()["channels"]]
    wide = summary(status(acquisition=acquired(channels=joints)), 100, with_joints=True)
    assert any("theta0 late " in line.text for line in wide)


def test_a_job_that_runs_is_told_before_those_that_wait() -> None:
    waiting = WORST["jobs"]
    text = screen(status(jobs=[*waiting, waiting[0] | {"id": 99, "state": "running"}]))
    assert "jobs      job 99 gap of s: running" in text


def test_jobs_that_wait_for_the_end_of_a_session_say_so() -> None:
    queued = {"id": 2, "kind": "report", "session_id": "s1", "state": "queued", "error": None, "progress": 0.0}
    assert job_lines({"jobs": [queued], "session": None}) == ["job 2 report of s1: queued"]
    told = "job 2 report of s1: queued, begins when session s2 has ended"
    assert job_lines({"jobs": [queued], "session": {"id": "s2"}}) == [told]


CANDIDATE = {
    "id": 2,
    "stage": "hybrid",
    "is_acceptable": True,
    "refused_because": None,
    "comparison": {"sentence": "x"},
}


GUIDE = {
    "id": 1,
    "prisms": ["r"],
    "step": {
        "id": "1.2",
        "title": "Aim at prism r",
        "instruction": "Aim the station at prism r and say so.",
        "button": "Station is on prism r",
        "is_busy": False,
        "is_detected": False,
    },
}


@pytest.mark.parametrize(
    ("told", "step"),
    [
        (WORST, "theta0: Check the encoder's power"),
        (status(setup=None), "`rigcal session guide --new-setup NAME`"),
        (status(), "`rigcal session start"),
        (status(session=session(control_shots=[])), "`rigcal session shoot NAME`"),
        (status(session=session()), "21 more poses"),
        (status(session=session(kind="check", poses=4)), "1 more pose,"),
        (status(session=session(poses=30)), "`rigcal session shoot cp1`"),
        (
            status(session=session(poses=30, control_shots=[{"point": "c", "phase": "end", "misclosure_mm": 1.0}])),
            "`rigcal session stop`",
        ),
        (status(jobs=WORST["jobs"]), "`rigcal watch`"),
        (status(models={"live": None, "candidate": CANDIDATE}), "`rigcal model accept 2`"),
        (status(models={"live": {"id": 1}, "candidate": None}), "nothing to do"),
        (status(guide=GUIDE, session=session()), "aim the station at prism r and say so: `rigcal session guide`"),
        (status(guide=GUIDE, alarms={"active": [alarm(1, "warning")], "looked_age_s": 0.5}), "aim the station"),
        (status(guide=GUIDE, alarms={"active": [alarm(1)], "looked_age_s": 0.5}), "theta1: Check the encoder's power"),
        (status(alarms={"active": [alarm(1, "warning")], "looked_age_s": 0.5}), "theta1: Check the encoder's power"),
    ],
)
def test_the_next_step_is_a_command_or_an_act(told: dict[str, Any], step: str) -> None:
    assert step in next_line(told)


def test_the_state_is_one_sentence() -> None:
    assert state_sentence(status()) == "ready, no model is live, no session is open"
    assert state_sentence(status(session=session())).startswith("recording session s001-r")
    held = status(alarms={"active": [], "looked_age_s": 90.0})
    assert state_sentence(held).startswith("blocked")


def test_a_job_that_runs_never_stands_at_100_percent() -> None:
    job = {"id": 1, "kind": "gap", "session_id": "s1", "state": "running", "error": None, "progress": 1.0}
    lines = job_lines({"jobs": [job | {"message": "drawing"}], "session": None})
    assert lines == ["job 1 gap of s1: running, 99 %: drawing"]
    assert [percent(share) for share in (0.0, 0.994, 0.999, 1.0)] == ["0 %", "99 %", "99 %", "99 %"]


def test_status_and_watch_of_a_daemon_are_plain_where_they_are_piped(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        socket = ["--socket", str(config.socket_path)]
        shown = CliRunner().invoke(main, ["status", *socket])
        assert len(shown.stdout.splitlines()) <= LINES
        assert "\x1b" not in shown.stdout
        told = json.loads(CliRunner().invoke(main, ["status", *socket, "--json"]).stdout)
        assert told["summary"]["next"].startswith("record the station's set-up")
        watched = CliRunner().invoke(main, ["watch", "--count", "2", "--interval", "0.2", *socket])
        assert (watched.exit_code, len(watched.stdout.splitlines())) == (0, 2)
        assert "theta1" in watched.stdout
        assert "\x1b" not in watched.stdout
    lost = CliRunner().invoke(main, ["watch", "--count", "1", *socket])
    assert lost.exit_code == 0
    assert "connection lost, retrying" in lost.stdout


def test_watch_refreshes_a_terminal_and_leaves_it_as_it_was(tmp_path: Path) -> None:
    with idle_daemon(tmp_path) as config:
        master, slave = pty.openpty()
        command = [sys.executable, "-m", "daemon.cli.main", "watch", "--count", "2", "--interval", "0.2"]
        watching = subprocess.Popen(
            [*command, "--socket", str(config.socket_path)], stdout=slave, env={**os.environ, "TERM": "xterm"}
        )
        os.close(slave)
        said = b""
        while select.select([master], [], [], 30)[0]:
            try:
                chunk = os.read(master, 4096)
            except OSError:  # Linux: the last writer has gone
                break
            said += chunk
        os.close(master)
        assert watching.wait(30) == 0
    assert said.startswith(b"\x1b[?1049h")
    assert said.endswith(b"\x1b[?25h\x1b[?1049l")
    assert said.count(b"\x1b[H") == 2
    assert b"joints" in said


def test_the_result_of_a_gap_job_says_which_stage_its_errors_are_of() -> None:
    found = {"effects": ["backlash@theta4"], "holdout": {"rms_before_mm": 22.6, "rms_after_mm": 3.1}}
    job = {"kind": "gap", "state": "done", "error": None, "result": {"sentence": "It lacked play.", "gap": found}}
    told = "It lacked play. Held-out error: calibrated kinematics 22.6 mm RMS, with the effects 3.10 mm."
    assert outcome(job) == told
    job["result"] = {"sentence": "Nothing lacked.", "gap": found | {"effects": []}}
    assert outcome(job) == "Nothing lacked. Held-out error of the calibrated kinematics: 22.6 mm RMS."
