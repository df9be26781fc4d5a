"""Warnings of a guide about fixes that do not count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from drivers.readings import DeviceEvent, EventKind, Record
from tests.daemon.guide.test_guide_store_order import POSE, GuidedRig
from tests.daemon.support.sessions import STEP_S, closed_afterwards


class WatchedRig(GuidedRig):
    """A rig whose guide sees the machine, as in a daemon."""

    def new_guide(self) -> Any:
        guide = super().new_guide()
        watch = guide._course.watch
        watch._joiner = ObservationJoiner(joint_inputs(self.machine), signal_inputs(self.machine), settle_s=0.5)
        return guide

    def tell(self, records: Sequence[Record]) -> None:
        super().tell(records)
        self.guide._course.watch._joiner.feed(records)
        self.guide.on_records(records)

    def at_a_pose(self, **request: Any) -> None:
        """A guide that waits for a pose of prism r, the station having been aimed."""
        self.guided("start", new_setup={"id": "S1"}, prisms=["r"], check_poses=0, **request)
        opened = self.keeper.start_command({"prism": "r", "setup": "S1"}, is_aimed=False)
        self.guide._course.happen("opened", {"session": opened["id"], "last": 0})
        self.guided("skip", reason="fog")
        self.guided("done")

    def jump(self) -> None:
        """Say that a joint has jumped: its readings, and so all fixes from now on, do not count."""
        now = self.clock.now()
        self.tell([DeviceEvent("theta1", now, EventKind.PRESET_JUMP, "theta1: jumped by 3 deg")])

    def warnings(self) -> list[str]:
        """What the guide says of fixes."""
        found = self.guide.state_command({})["guide"]["messages"]
        return [message["text"] for message in found if message["text"].startswith("the fixes")]


rig = closed_afterwards(WatchedRig)


def test_a_fault_of_a_joint_is_told_without_a_question_about_the_prism(rig: WatchedRig) -> None:
    rig.at_a_pose(plan=[POSE] * 6)
    rig.jump()
    rig.live(2.0)
    (warning,) = rig.warnings()
    assert "theta1 jumped" in warning
    assert "prism" not in warning


def test_a_boom_that_has_just_come_to_a_stand_is_not_said_to_move(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig.clock, "real_seconds", lambda seconds: seconds)  # fixes age as this clock goes
    rig.steps_of_fix = 14
    rig.at_a_pose(plan=[POSE] * 6)
    rig.live(14 * STEP_S, theta1=5.0)
    reasons, stood_s = [], []
    for _ in range(13):
        rig.live(STEP_S)
        reasons.append(rig.keeper.not_counting(1.0))
        stood_s.append(rig.guide.state_command({})["guide"]["hold"]["since_s"])
        assert rig.warnings() == []
    assert reasons[-1] == "moving"
    assert stood_s[-1] > 0.5


def test_a_boom_that_stands_since_the_start_of_the_daemon_is_said_to_stand(rig: WatchedRig) -> None:
    rig.at_a_pose(plan=[POSE] * 6)
    rig.live(2.0)
    assert rig.guide.state_command({})["guide"]["hold"]["since_s"] == pytest.approx(2.0, abs=2 * STEP_S)


def test_fixes_that_do_not_count_are_told_however_late_they_arrive(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig.clock, "real_seconds", lambda seconds: seconds)  # fixes age as this clock goes
    rig.at_a_pose(plan=[POSE] * 6)
    rig.jump()
    rig.live(6.0)
    rig.steps_of_fix = 10**6  # the next fix is still on its way
    rig.live(2.0)
    (warning,) = rig.warnings()
    assert "theta1 jumped" in warning


def test_nothing_is_told_of_fixes_while_poses_are_chosen(rig: WatchedRig) -> None:
    rig.at_a_pose(poses=6)
    rig.jump()
    rig.live(2.0)
    assert rig.guide.state_command({})["guide"]["step"]["kind"] == "planning"
    assert rig.keeper.not_counting(1.0)
    assert rig.warnings() == []
