"""A guide whose gain meter does not answer."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest

from daemon.commands import CommandError
from daemon.guide import meter_link
from daemon.guide.meter_link import Place
from tests.daemon.guide.test_guide_store_order import POSE
from tests.daemon.guide.test_guide_warnings import WatchedRig
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.sessions import SOURCE, closed_afterwards

HANGS = "import os, signal; os.kill(os.getpid(), signal.SIGSTOP)"
POSES = [{joint.name: POSE[joint.column] for joint in SOURCE.rig.joints}] * 6
CHOOSES = f"""import json, sys
sys.stdin.readline()
for line in sys.stdin:
    is_choice = json.loads(line)["do"] == "choose"
    print(json.dumps({{"result": {{"poses": {POSES}}}}} if is_choice else {{"error": "too few poses"}}), flush=True)
"""

rig = closed_afterwards(WatchedRig)


def choosing(rig: WatchedRig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A guide that asks a gain meter that hangs for poses."""
    meter_that(HANGS, monkeypatch)
    rig.guide._course.advisor._place = lambda: Place("rigcal.sqlite", None, "")
    rig.at_a_pose(poses=6)
    rig.guide._worker._look()


def meter_that(does: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meter_link, "METER_COMMAND", (sys.executable, "-c", does))


def overdue(rig: WatchedRig) -> Any:
    """The link to the gain meter, once the time for the first of its two questions is over."""
    link: Any = rig.guide._course.advisor._meter
    wait_until(lambda: len(link._waiting) == 1 and link._due < math.inf)
    assert link.is_alive
    link._due = 0.0
    return link


def texts(rig: WatchedRig) -> list[str]:
    return [message["text"] for message in rig.guide.state_command({})["guide"]["messages"]]


def test_a_gain_meter_that_hangs_is_reported_and_restarted(rig: WatchedRig, monkeypatch: pytest.MonkeyPatch) -> None:
    choosing(rig, monkeypatch)
    assert rig.guide.meter_fault is None
    hung = overdue(rig)
    meter_that(CHOOSES, monkeypatch)
    rig.guide._worker._look()
    assert hung._process.poll() is not None
    wait_until(lambda: rig.guide.state_command({})["guide"]["step"]["kind"] != "planning")
    assert rig.guide.meter_fault is None
    rig.guide.stop()


def test_a_gain_meter_that_hangs_again_is_reported_until_the_guide_ends(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    choosing(rig, monkeypatch)
    for _ in range(2):
        overdue(rig)
        rig.guide._worker._look()
        assert "did not answer in time and was restarted" in str(rig.guide.meter_fault)
        assert rig.guide.meter_fault in texts(rig)
    rig.guided("stop", reason="the computer is busy")
    assert rig.guide.meter_fault is None


def test_poses_that_are_being_chosen_are_not_skipped_one_at_a_time(rig: WatchedRig) -> None:
    rig.at_a_pose(poses=6)
    before = rig.known()
    with pytest.raises(CommandError, match="cannot be skipped: Choosing the poses; with `rest`, all poses"):
        rig.guided("skip", reason="a wall")
    assert rig.known() == before
    assert rig.guided("skip", reason="a wall", rest=True)["step"]["phase"] == "end"


def test_an_event_that_cannot_happen_is_refused_with_the_step(rig: WatchedRig) -> None:
    rig.at_a_pose(poses=6)
    with pytest.raises(CommandError, match="no pose is left; the guide is at this step: Choosing the poses"):
        rig.guide._course.happen("measured", {"pose": "1.1", "last": 1})
