"""A step of a guide is skipped, or the guide abandoned, while the guide's thread works on that step."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from daemon.commands import CommandError, acting_for
from tests.daemon.guide.test_guide_store_order import POSE
from tests.daemon.guide.test_guide_warnings import WatchedRig
from tests.daemon.support.sessions import STEP_S, closed_afterwards

rig = closed_afterwards(WatchedRig)


def before_work(rig: WatchedRig, monkeypatch: pytest.MonkeyPatch, happens: Callable[[], object]) -> None:
    """Let something happen between the look at the guide and the work that the look finds necessary."""
    work = rig.guide._worker._try

    def late(*arguments: Any) -> None:
        happens()
        work(*arguments)

    monkeypatch.setattr(rig.guide._worker, "_try", late)


def skip_prism(rig: WatchedRig) -> None:
    rig.guided("skip", reason="fog")
    rig.guided("skip", reason="fog")


def sessions(rig: WatchedRig) -> list[tuple[str, str]]:
    return [(session["prism"], session["state"]) for session in rig.keeper.list_command({})]


def trouble(rig: WatchedRig) -> str:
    job = rig.guide._course.record.job
    assert job is not None
    return job.trouble


@pytest.mark.parametrize("is_first", [True, False])
def test_a_session_whose_prism_is_skipped_while_it_is_opened_is_aborted_and_that_of_the_next_prism_opened(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch, is_first: bool
) -> None:
    start = rig.keeper.start_command

    def with_skips(*arguments: Any, **more: Any) -> dict[str, Any]:
        if is_first:
            skip_prism(rig)
        opened = start(*arguments, **more)
        if not is_first:
            skip_prism(rig)
        return opened

    rig.guided("start", new_setup={"id": "S1"}, prisms=["r", "s"], poses=6, check_poses=0)
    with monkeypatch.context() as patch:
        patch.setattr(rig.keeper, "start_command", with_skips)
        rig.guide._worker._open_session()
    shown = rig.guide.state_command({})["guide"]
    assert (shown["prism"], shown["session"]) == ("s", None)
    assert sessions(rig) == [("r", "aborted")]
    rig.guide._worker._look()
    assert rig.guide.state_command({})["guide"]["session"] == "s002-s"
    assert sessions(rig) == [("r", "aborted"), ("s", "open")]


def test_a_session_of_the_guide_that_was_left_open_for_a_skipped_prism_is_aborted(rig: WatchedRig) -> None:
    rig.guided("start", new_setup={"id": "S1"}, prisms=["r", "s"], poses=6, check_poses=0)
    skip_prism(rig)
    rig.say("start", prism="r", setup="S1", note="guide 1")  # as if the daemon had ended before the session's abort
    rig.guide._worker._look()
    assert sessions(rig) == [("r", "aborted"), ("s", "open")]


def test_a_control_point_that_is_skipped_just_before_its_shot_is_not_shot(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.guided("start", new_setup={"id": "S1"}, prisms=["r"], poses=6, check_poses=0)
    rig.guide._worker._look()
    rig.guided("done")
    before_work(rig, monkeypatch, lambda: rig.guided("skip", reason="fog"))
    looking = threading.Thread(target=rig.guide._worker._look)
    looking.start()
    while looking.is_alive():
        rig.live(STEP_S)
    assert rig.setups.control_point_names("S1") == []
    assert rig.known()["step"]["title"] == "Aim at prism r"


def test_a_guide_that_is_opened_while_another_closes_its_session_is_left_alone(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.at_a_pose(plan=[POSE])
    rig.guided("skip", reason="fog", rest=True)
    rig.guided("skip", reason="fog")
    assert rig.known()["step"]["kind"] == "close"

    def begin_again() -> None:
        rig.guided("stop", reason="fog")
        rig.guided("start", setup="S1", prisms=["r"], plan=[POSE], check_poses=0)

    before_work(rig, monkeypatch, begin_again)
    rig.guide._worker._look()
    assert rig.known()["steps"][0]["state"] == "now"
    assert trouble(rig) == ""


def test_a_standstill_counts_for_one_pose(rig: WatchedRig) -> None:
    rig.at_a_pose(plan=[POSE] * 2)
    rig.values["theta1"] += 30.0
    rig.live(3.0)
    rig.guide._worker._look()
    assert rig.guided("done")["poses"]["done"] == 1
    with pytest.raises(CommandError, match="0 of 5 fixes count at this standstill"):
        rig.guided("done")


def test_a_button_that_is_pressed_while_the_shot_of_an_earlier_step_ends_is_not_lost(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = ["cp1", "cp2"]
    rig.guided("start", new_setup={"id": "S1"}, control_points=points, prisms=["r"], poses=6, check_poses=0)
    rig.guide._worker._look()
    rig.guided("done")

    def shoot(*_arguments: Any, **_more: Any) -> dict[str, Any]:
        rig.guide._course.happen("skipped", {"reason": "fog"})
        with acting_for(None):  # a command of the operator, who is connected
            rig.guided("done")
        raise CommandError("the shot was cancelled, and nothing was stored")

    monkeypatch.setattr(rig.keeper, "shoot_command", shoot)
    rig.guide._worker._look()
    assert rig.guide._worker.wanted == rig.known()["step"]["id"] == "1.2"
    assert trouble(rig) == ""
