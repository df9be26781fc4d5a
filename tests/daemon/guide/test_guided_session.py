"""Guided sessions with the whole daemon: real sockets and processes, a simulated rig that is moved as by hand."""

from __future__ import annotations

import getpass
import json
import os
import pty
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.commands import REFUSED, CommandError
from tests.daemon.support.daemon_process import DaemonProcess
from tests.simulated.guided_operator import GuidedOperator

pytestmark = pytest.mark.long

SIM = ("--sim", "--by-hand", "--rate", "10", "--seed", "3")


def ready(directory: Path) -> DaemonProcess:
    daemon = DaemonProcess(directory, *SIM, jobs=False)
    daemon.wait("an answer", daemon.answers)
    daemon.say("simulation.aim", target="r")
    daemon.wait("a fix", daemon.has_fix)
    return daemon


def state(daemon: DaemonProcess) -> dict[str, Any]:
    return dict(daemon.say("guide.state")["guide"])


def rigcal(daemon: DaemonProcess, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run("session", "guide", "--socket", str(daemon.socket), *arguments)


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "daemon.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_whole_guide_survives_a_kill_and_ends_with_sessions_that_are_used(tmp_path: Path) -> None:
    daemon = ready(tmp_path)
    try:
        assert daemon.say("guide.state") == {"guide": None}
        started = daemon.say(
            "guide.start", new_setup={"id": "S1"}, prisms=["r", "s"], poses=6, check_poses=3, operator="Ada"
        )["guide"]
        assert (started["state"], started["prism"], started["step"]["point"]) == ("open", "r", "cp1")
        operator = GuidedOperator(daemon.say)
        operator.follow(lambda s: s["step"]["kind"] in ("go_to_pose", "hold"))
        skipped = daemon.say("guide.skip", reason="a wall is in the way")["guide"]
        assert skipped["steps"][2]["poses"]["skipped"] == [{"pose": 1, "reason": "a wall is in the way"}]
        before = operator.follow(lambda s: s["poses"]["done"] == 2 and s["prism"] == "r")
        daemon.kill()

        daemon = ready(tmp_path)
        after = state(daemon)
        for key in ("id", "state", "prism", "session", "poses", "operator", "steps"):
            assert after[key] == before[key], key
        assert after["step"]["id"] == before["step"]["id"]
        assert after["taps"] == before["taps"] == 1 + operator.taps + 1  # the start, the buttons, the skipped pose
        # The boom of the new simulation stands elsewhere: no fix counts until the operator says that it is the prism.
        operator = GuidedOperator(daemon.say)
        told: list[dict[str, Any]] = []
        end = operator.follow(lambda s: told.append(s["accuracy"] or {}) or s["state"] != "open")
        assert end["state"] == "finished", end
        assert operator.taps == 2  # the station is on prism s, for its session and for the check: all else by itself
        of_r = [one for one in told if one.get("prisms") == ["r"] and one["prism_mm"] is not None]
        assert of_r
        assert all(one["prism_mm"] > one["prism_after_5_mm"] > 0.0 for one in of_r)
        assert end["accuracy"]["prisms"] == ["r", "s"]
        assert 0.0 < end["coverage"]["volume_share"] <= 1.0
        sessions = daemon.say("session.list")
        assert [(s["prism"], s["kind"], s["state"], s["not_used"]) for s in sessions] == [
            ("r", "static_poses", "closed", None),
            ("s", "static_poses", "closed", None),
            ("s", "check", "closed", None),
        ]
        # Where the boom stood before it went to the first pose may count as well.
        assert all(s["poses"] - least in (0, 1, 2) for s, least in zip(sessions, (5, 6, 3), strict=True))
        assert end["misclosure_mm"] < 5.0
        # The sessions are the operator's again.
        assert daemon.say("session.start", prism="r")["id"]
        daemon.say("session.abort")
    finally:
        assert daemon.stop() == 0, daemon.log_text()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaemonProcess]:
    made = ready(tmp_path_factory.mktemp("rig"))
    made.say("setup.new", id="S1")
    yield made
    assert made.stop() == 0, made.log_text()


@pytest.fixture
def guide(daemon: DaemonProcess) -> Iterator[dict[str, Any]]:
    """A guide at its first step, at a set-up of its own, and no guide afterwards."""
    daemon.say("simulation.aim", target="r")
    setup = {"id": f"G{len(daemon.say('setup.list'))}"}
    yield daemon.say("guide.start", new_setup=setup, prisms=["r"], poses=6, check_poses=0, operator="Ada")["guide"]
    if state(daemon)["state"] == "open":
        daemon.say("guide.stop", reason="the test is over")


@pytest.mark.usefixtures("guide")
def test_commands_that_a_guide_gives_itself_are_refused_with_the_next_step(daemon: DaemonProcess) -> None:
    daemon.wait("the session", lambda: state(daemon)["session"])
    assert daemon.say("status")["guide"]["step"]["title"] == "Shoot control point cp1"
    for command, arguments in (
        ("session.start", {"prism": "r"}),
        ("session.stop", {}),
        ("session.abort", {}),
        ("session.shoot", {"point": "cp1"}),
        ("setup.new", {"id": "S2"}),
        ("guide.start", {}),
    ):
        with pytest.raises(CommandError, match="Shoot control point cp1") as refused:
            daemon.say(command, **arguments)
        assert refused.value.status == REFUSED, command
    with pytest.raises(CommandError, match="the guide is now at a different step") as refused:
        daemon.say("guide.done", step="1.9")
    assert refused.value.status == REFUSED
    with pytest.raises(CommandError, match="give a reason"):
        daemon.say("guide.skip", reason=" ")
    assert daemon.say("session.list")[-1]["state"] == "open"


@pytest.mark.usefixtures("guide")
def test_skipped_control_points_are_kept_and_the_session_is_not_used(daemon: DaemonProcess) -> None:
    daemon.wait("the session", lambda: not state(daemon)["step"]["is_busy"])
    daemon.say("guide.skip", reason="fog")
    operator = GuidedOperator(daemon.say)
    reached = operator.follow(lambda s: s["step"]["kind"] == "go_to_pose")
    assert "fog" in reached["messages"][-1]["text"]
    operator.follow(lambda s: s["poses"]["done"] == 1)
    ended = daemon.say("guide.stop", reason="rain")["guide"]
    assert (ended["state"], ended["step"]["kind"]) == ("abandoned", "abandoned")
    assert "rain" in ended["step"]["instruction"]
    session = daemon.say("session.list")[-1]
    assert session["state"] == "closed"
    assert "control point" in session["not_used"]
    assert (session["operator"], session["user"]) == ("Ada", getpass.getuser()), "of the process that started the guide"
    assert daemon.say("session.start", prism="r")["id"]  # the sessions are the operator's again
    daemon.say("session.abort")


def test_a_guide_warns_of_no_joint_while_all_are_read(guide: dict[str, Any]) -> None:
    assert guide["messages"] == []


@pytest.mark.usefixtures("guide")
def test_hands_of_a_simulated_rig_aim_and_go_where_the_guide_says(daemon: DaemonProcess) -> None:
    def hand(*arguments: str) -> str:
        done = run("hand", *arguments, "--socket", str(daemon.socket))
        return done.stderr if done.returncode else done.stdout

    assert "no guide asks for a pose now" in hand("move")
    assert "there is no joint 'elbow'" in hand("move", "elbow=3")
    assert "write it as theta1=30" in hand("move", "theta1")
    assert "beyond its limits" in hand("move", "theta1=900")
    assert "theta1_deg 10.0" in hand("move", "theta1=10")
    daemon.wait("theta1", lambda: abs(state(daemon)["joints"][0]["now"] - 10.0) < 0.5)
    daemon.say("guide.skip", reason="fog")
    assert hand("aim", "r") == "the station is aimed at r\n"
    done = rigcal(daemon, "--done")
    assert done.stdout.startswith("confirmed: Aim at prism r\n"), done
    daemon.wait("a pose", lambda: state(daemon)["step"]["kind"] == "go_to_pose")
    assert hand("move").startswith("the boom moves to theta1_deg")
    daemon.wait("the boom", lambda: all(joint["is_there"] for joint in state(daemon)["joints"]))
    assert "theta1 is given twice" in hand("move", "theta1=1", "theta1=2")


@pytest.mark.usefixtures("guide")
def test_a_station_that_was_left_on_the_control_point_is_told_at_the_pose(daemon: DaemonProcess) -> None:
    operator = GuidedOperator(daemon.say)
    operator.follow(lambda s: s["step"]["kind"] == "change_prism")
    daemon.say("guide.done")  # the station is on the control point still
    operator.follow(lambda s: s["step"]["kind"] == "hold")
    daemon.wait("the reason", lambda: any("a control point" in m["text"] for m in state(daemon)["messages"]))
    daemon.say("simulation.aim", target="r")
    daemon.wait("a pose", lambda: state(daemon)["poses"]["done"])


@pytest.mark.usefixtures("guide")
def test_enough_goes_on_when_told_and_takes_more_poses_when_asked(daemon: DaemonProcess) -> None:
    operator = GuidedOperator(daemon.say)
    operator.follow(lambda s: s["poses"]["done"] == 1 and s["step"]["kind"] == "go_to_pose")
    enough = daemon.say("guide.skip", reason="dinner", rest=True)["guide"]
    assert enough["step"]["phase"] == "end"
    assert [one["reason"] for one in enough["steps"][2]["poses"]["skipped"]] == ["dinner"] * 5
    ended = operator.follow(lambda s: s["state"] != "open")
    assert ended["state"] == "finished"
    assert ended["model"] == {
        "id": None, "is_acceptable": None, "refused_because": None, "sentence": None, "jobs": 0
    }  # fmt: skip


@pytest.mark.usefixtures("guide")
def test_the_terminal_leads_and_scripts_may_answer(daemon: DaemonProcess) -> None:
    daemon.wait("the session", lambda: not state(daemon)["step"]["is_busy"])
    shown = rigcal(daemon, "--json")
    assert json.loads(shown.stdout)["guide"]["step"]["kind"] == "shoot_control_point"
    text = rigcal(daemon, "--state").stdout
    assert "Shoot control point cp1" in text
    assert rigcal(daemon, "--done", "--state").returncode == 2
    skipped = rigcal(daemon, "--skip", "fog")
    assert skipped.returncode == 0
    assert "Aim at prism r" in skipped.stdout

    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "daemon.cli.main", "session", "guide", "--socket", str(daemon.socket)]
    leading = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    try:
        daemon.say("simulation.aim", target="r")
        said = read_until(ours, "Aim at prism r")
        os.write(ours, b"\n")
        said = read_until(ours, "to go")
        assert "theta1" in said
        os.write(ours, b"s")
        read_until(ours, "why")
        os.write(ours, b"a wall\n")
        daemon.wait("the skipped pose", lambda: state(daemon)["poses"]["skipped"])
        os.write(ours, b"q")
        said = read_until(ours, "stays open")
        assert leading.wait(timeout=30) == 0
    finally:
        leading.kill()
        leading.wait()
        os.close(ours)
    assert state(daemon)["steps"][2]["poses"]["skipped"] == [{"pose": 1, "reason": "a wall"}]


def test_a_shot_of_something_else_is_refused_and_a_station_that_moved_ends_the_guide(daemon: DaemonProcess) -> None:
    def opened(setup: str, cp1: list[float]) -> None:
        new_setup = {"id": setup, "control_points": {"cp1": cp1}}
        daemon.say("guide.start", new_setup=new_setup, prisms=["r"], poses=6, check_poses=0)
        daemon.wait("the session", lambda: not state(daemon)["step"]["is_busy"])

    daemon.say("simulation.aim", target="cp1")
    opened("elsewhere", [9e3, 9e3, 9e3])
    daemon.say("guide.done")
    daemon.wait("a word about the shot", lambda: "nothing was stored" in str(state(daemon)["messages"]))
    refused = state(daemon)
    assert "from control point cp1, and nothing was stored: aim at cp1" in str(refused["messages"])
    assert (refused["step"]["kind"], refused["step"]["button"] is not None) == ("shoot_control_point", True)
    daemon.say("guide.stop", reason="the test goes on")
    setups = {setup["id"]: setup for setup in daemon.say("setup.list")}
    assert setups["elsewhere"]["state"] == "ok"

    daemon.say("guide.start", new_setup={"id": "here"}, prisms=["r"], poses=6, check_poses=0)
    shot = GuidedOperator(daemon.say).follow(lambda s: s["step"]["kind"] == "change_prism")
    assert shot["state"] == "open"
    (point,) = next(setup for setup in daemon.say("setup.list") if setup["id"] == "here")["control_points"]
    daemon.say("guide.stop", reason="the test goes on")
    daemon.say("simulation.aim", target="cp1")
    opened("moved", [point["x_mm"] + 50.0, point["y_mm"], point["z_mm"]])
    daemon.wait("its end", lambda: state(daemon)["state"] != "open")
    assert state(daemon)["state"] == "abandoned"
    assert "the station has moved" in state(daemon)["step"]["instruction"]
    assert daemon.say("session.list")[-1]["state"] == "aborted"


def read_until(descriptor: int, text: str) -> str:
    said, deadline = "", time.monotonic() + 200.0
    while text not in said:
        assert time.monotonic() < deadline, said
        try:
            said += os.read(descriptor, 65536).decode("utf-8", "replace")
        except OSError:
            pytest.fail(f"it ended: {said}")
    return said
