"""A command to a guide is carried out as a whole or not at all, whatever the disk refuses of it."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from pathlib import Path
from typing import Any

import pytest

from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.commands import HOW_TO_END, CommandError
from daemon.guide.manager import GuideManager
from daemon.guide.meter_link import Place
from tests.daemon.support.damage import fill_up, make_room
from tests.daemon.support.sessions import SOURCE, Rig, closed_afterwards, disk_fails
from tests.daemon.support.store import table

POSE = {joint.column: sum(joint.limits) / 2 for joint in SOURCE.rig.joints}


class GuidedRig(Rig):
    """A rig with a guide whose own thread does not run: what it would do, the tests do."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.guide = self.new_guide()

    def new_guide(self) -> GuideManager:
        return GuideManager(
            self.machine,
            self.store,
            self.keeper,
            self.setups,
            ObservationJoiner(joint_inputs(self.machine), signal_inputs(self.machine), settle_s=0.5),
            self.clock,
            meter_place=_no_meter,
            model=dict,
            settle_s=0.5,
            has_aim=False,
        )

    def guided(self, command: str, **arguments: Any) -> dict[str, Any]:
        return dict(getattr(self.guide, f"{command}_command")(arguments)["guide"])

    def after_the_point(self) -> None:
        """A guide that waits for the station to be aimed at prism r, its session being open."""
        self.guided("start", new_setup={"id": "S1"}, prisms=["r", "s"], poses=6, check_poses=0)
        opened = self.keeper.start_command({"prism": "r", "setup": "S1"}, is_aimed=False)
        self.guide._course.happen("opened", {"session": opened["id"], "last": 0})
        self.guided("skip", reason="fog")

    def known(self) -> dict[str, Any]:
        """What the guide shows, without what goes by the clock."""
        shown = self.guide.state_command({})["guide"]
        return {key: shown[key] for key in ("state", "step", "steps", "session", "taps")}

    def restarted(self) -> dict[str, Any]:
        """What a daemon that starts now makes of what is stored."""
        self.keeper = self.new_keeper()
        self.guide = self.new_guide()
        return self.known()


def _no_meter() -> Place:
    raise OSError("none is needed")


rig = closed_afterwards(GuidedRig)


def test_a_guide_that_finds_the_disk_full_leaves_no_set_up_behind_and_starts_when_it_is_asked_again(
    rig: GuidedRig,
) -> None:
    asked = {"new_setup": {"id": "S1"}, "prisms": ["r"], "plan": [POSE] * 100, "check_poses": 0}
    fill_up(rig.store)
    with pytest.raises(sqlite3.OperationalError, match="database or disk is full"):
        rig.guided("start", **asked)
    assert rig.setups.list_command({}) == []
    assert rig.guide.state_command({}) == {"guide": None}
    make_room(rig.store)
    assert rig.guided("start", **asked)["state"] == "open"
    assert [setup["id"] for setup in rig.setups.list_command({})] == ["S1"]


@pytest.mark.parametrize("is_first", [True, False])
def test_a_guide_that_is_abandoned_while_its_session_is_being_opened_leaves_none_open(
    rig: GuidedRig, monkeypatch: pytest.MonkeyPatch, is_first: bool
) -> None:
    start = rig.keeper.start_command

    def with_a_stop(*arguments: Any, **more: Any) -> dict[str, Any]:
        if is_first:
            rig.guided("stop", reason="fog")
        opened = start(*arguments, **more)
        if not is_first:
            rig.guided("stop", reason="fog")
        return opened

    rig.guided("start", new_setup={"id": "S1"}, prisms=["r"], poses=6, check_poses=0)
    monkeypatch.setattr(rig.keeper, "start_command", with_a_stop)
    rig.guide._worker._open_session()
    assert rig.keeper.open_session() is None
    assert [session["state"] for session in rig.keeper.list_command({})] == ["aborted"]
    assert rig.known()["state"] == "abandoned"
    assert rig.guided("start", new_setup={"id": "S2"}, prisms=["r"], poses=6, check_poses=0)["state"] == "open"


def test_no_guide_is_opened_beside_a_session_that_is_being_started(rig: GuidedRig) -> None:
    refused: list[CommandError] = []

    def guide() -> None:
        try:
            rig.guided("start", setup="S1", prisms=["r"], poses=6, check_poses=0)
        except CommandError as error:
            refused.append(error)

    asking = threading.Thread(target=guide)

    def aim(_target: str) -> None:  # it takes a while, and another client asks for a guide
        asking.start()
        asking.join(timeout=1.0)

    rig.keeper = rig.new_keeper(aim)
    rig.guide = rig.new_guide()
    rig.say("setup_new", id="S1")
    opened = rig.say("start", prism="r", kind="check")
    asking.join()
    assert [str(error) for error in refused] == [f"session {opened['id']!r} is open; {HOW_TO_END}"]
    assert rig.guide.state_command({}) == {"guide": None}


def test_a_guide_is_refused_at_once_while_a_shot_is_waited_for(rig: GuidedRig) -> None:
    held, is_over = threading.Event(), threading.Event()

    def shoot() -> None:  # as a command does that waits for fixes
        with rig.keeper.turn:
            held.set()
            is_over.wait(20)

    rig.say("setup_new", id="S1")
    rig.say("start", prism="r")
    shooting = threading.Thread(target=shoot)
    shooting.start()
    held.wait()
    with pytest.raises(CommandError, match="is open; stop or abort it first"):
        rig.guided("start", setup="S1", prisms=["r"], poses=6, check_poses=0)
    assert shooting.is_alive()
    is_over.set()
    shooting.join()


def test_no_session_is_started_beside_a_guide_that_is_being_opened(rig: GuidedRig) -> None:
    start = rig.guide.guarding("session.start", rig.keeper.start_command)
    rig.guided("start", new_setup={"id": "S1"}, prisms=["r"], poses=6, check_poses=0)
    with pytest.raises(CommandError, match=r"session\.start is refused: guide 1 is open"):
        start({"prism": "r"})


@pytest.mark.parametrize(
    "other", [{"prism": "r", "kind": "check"}, {"prism": "r", "setup": "S0"}, {"prism": "r"}, {"prism": "s"}]
)
def test_a_guide_takes_no_other_session_for_its_own(rig: GuidedRig, other: dict[str, Any]) -> None:
    rig.say("setup_new", id="S0")
    rig.guided("start", new_setup={"id": "S1"}, prisms=["r"], poses=6, check_poses=0)
    rig.say("start", **other)
    rig.guide._worker._look()
    shown = rig.guide.state_command({})["guide"]
    assert shown["session"] in ("", None)
    assert any("is open" in told["text"] for told in shown["messages"])


@pytest.mark.parametrize("command", ["skip", "stop"])
def test_a_session_that_a_command_ends_stays_open_where_the_guide_cannot_store_why(
    rig: GuidedRig, command: str
) -> None:
    rig.after_the_point()
    before = rig.known()
    leave_no_room_for_an_event(rig)
    with pytest.raises(sqlite3.OperationalError, match="database or disk is full"):
        rig.guided(command, reason="fog")
    opened = rig.keeper.open_session()
    assert opened is not None
    assert opened["state"] == "open"
    assert rig.known() == before
    make_room(rig.store)
    assert rig.restarted() == before, "what is stored is what was known"
    after = rig.guided(command, reason="fog")
    assert after["taps"] == before["taps"] + 1
    assert [session["state"] for session in rig.keeper.list_command({})] == ["aborted"]


def test_the_word_that_the_station_is_aimed_counts_for_session_and_guide_or_for_none(rig: GuidedRig) -> None:
    rig.after_the_point()
    before = rig.known()
    rig.live(1)
    leave_no_room_for_an_event(rig)
    with pytest.raises(sqlite3.OperationalError, match="database or disk is full"):
        rig.guided("done")
    make_room(rig.store)
    rig.live(1)
    assert table(rig.store.path, "prism_confirmations") == []
    assert rig.keeper.open_session()["observations"] == 0, "the station is on no prism yet"  # type: ignore[index]
    assert rig.known()["taps"] == before["taps"]
    assert rig.guided("done")["step"]["kind"] != "change_prism"
    rig.live(1)
    assert rig.keeper.open_session()["observations"] > 10  # type: ignore[index]


def test_a_command_that_the_disk_refuses_is_not_counted(rig: GuidedRig) -> None:
    rig.after_the_point()
    before = rig.known()
    for command in ("skip", "stop", "done"):
        with disk_fails(), pytest.raises(sqlite3.OperationalError):
            rig.guided(command, reason="rain")
    assert rig.known() == before
    assert rig.restarted() == before


def leave_no_room_for_an_event(rig: GuidedRig) -> None:
    """Fill the disk, and then the page in which the newest event of the guide stands."""
    fill_up(rig.store)
    with contextlib.suppress(sqlite3.OperationalError):
        while True:
            rig.guide._course.happen("failed", {"text": ""})
