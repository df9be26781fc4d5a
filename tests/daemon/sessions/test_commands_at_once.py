"""A session's command stores all of its things or none, whatever the disk refuses, and none if its caller has left."""

from __future__ import annotations

import contextlib
import json
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.commands import CommandTurn, acting_for
from daemon.control.server import ControlServer
from daemon.store.queries.observations import OF_CONTROL_POINT
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.damage import fill_up, make_room
from tests.daemon.support.sessions import STEP_S, Rig, disk_fails
from tests.daemon.support.store import table

POINT_MM = (9000.0, 500.0, 2000.0)


def shoot_without_storing_fixes(rig: Rig) -> dict[str, Any] | sqlite3.Error:
    """Shoot the control point while its fixes are told and not stored, as the disk may be full; what comes of it."""
    answers: list[dict[str, Any] | sqlite3.Error] = []

    def ask() -> None:
        try:
            answers.append(rig.say("shoot", point="cp1"))
        except sqlite3.Error as error:
            answers.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    wait_until(lambda: rig.keeper._shot is not None or not asking.is_alive())
    while asking.is_alive():
        rig.clock.advance(STEP_S)
        rig.tell([rig.fix()])
    asking.join()
    return answers[0]


def leave_no_room_for_a_word(rig: Rig, session_id: str) -> None:
    """Fill the disk, and then the page in which the newest word stands that a station is on its session's prism."""
    fill_up(rig.store)
    word = {"session_id": session_id, "turning": True, **rig.store.instant(rig.clock.now())}
    with contextlib.suppress(sqlite3.OperationalError):
        while True:
            rig.store.insert("prism_confirmations", word)


def test_a_shot_is_not_kept_where_the_fixes_before_it_cannot_be_told_from_those_of_the_prism(session_rig: Rig) -> None:
    session_rig.target_mm = POINT_MM
    session_rig.say("start", prism="r")
    session_rig.live(5)
    fill_up(session_rig.store)
    assert "database or disk is full" in str(shoot_without_storing_fixes(session_rig))
    make_room(session_rig.store)
    for name in ("control_points", "control_shots"):
        assert table(session_rig.store.path, name) == [], name
    session_rig.live(1)
    reasons = {row["excluded"] for row in table(session_rig.store.path, "observations")}
    assert OF_CONTROL_POINT not in reasons, "nothing has told yet that one is there"
    assert session_rig.shoot("cp1", POINT_MM)["misclosure_mm"] is None, "it is the first shot"
    assert all(row["excluded"] for row in table(session_rig.store.path, "observations"))
    assert session_rig.say("show", id="s001-r")["excluded"][OF_CONTROL_POINT] > 80


def test_a_session_is_not_open_where_it_cannot_be_stored_that_its_station_was_turned(session_rig: Rig) -> None:
    session_rig.keeper = session_rig.new_keeper(session_rig.aimed.append)
    name = session_rig.say("start", prism="r")["id"]
    session_rig.say("abort")
    leave_no_room_for_a_word(session_rig, name)
    with pytest.raises(sqlite3.OperationalError, match="database or disk is full"):
        session_rig.say("start", prism="b")
    assert session_rig.keeper.open_session() is None
    assert [row["id"] for row in table(session_rig.store.path, "calibration_sessions")] == [name]
    make_room(session_rig.store)
    assert session_rig.say("start", prism="b")["id"] == "s002-b"


def test_a_shot_is_answered_where_it_cannot_be_stored_that_the_station_was_turned_back(
    session_rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    def aim(target: str) -> None:
        session_rig.aimed.append(target)
        if session_rig.aimed == ["r", "cp1", "r"]:
            leave_no_room_for_a_word(session_rig, "s001-r")

    session_rig.keeper = session_rig.new_keeper(aim)
    session_rig.say("start", prism="r")
    prism_mm, session_rig.target_mm = session_rig.target_mm, POINT_MM
    answer = shoot_without_storing_fixes(session_rig)
    assert isinstance(answer, dict)
    assert answer["point"] == "cp1"
    assert "the end of a shot of control point cp1 will be stored later" in caplog.text
    assert len(table(session_rig.store.path, "control_shots")) == 1
    make_room(session_rig.store)
    session_rig.target_mm = prism_mm
    session_rig.live(2)
    assert session_rig.say("show", id="s001-r")["observations"] > 10, "its fixes are its observations again"
    kinds = [row["kind"] for row in table(session_rig.store.path, "device_events")]
    assert kinds.count("shot_begun") == kinds.count("shot_ended") == 1, "a restart knows that the shot has ended"


def test_an_observation_that_can_never_be_stored_takes_none_of_those_that_wait_with_it(
    session_rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    session_rig.say("start", prism="r")
    session_rig.live(1)
    session_rig.observing = disk_fails
    session_rig.live(0.5)
    with disk_fails():
        tell_a_fix_of_the_far_future(session_rig)
    session_rig.live(0.5)
    session_rig.observing = contextlib.nullcontext
    session_rig.live(1)
    observed = [row["monotonic_ns"] for row in table(session_rig.store.path, "observations")]
    measured = [row["monotonic_ns"] for row in table(session_rig.store.path, "fixes")]
    assert observed == measured[: len(observed)]
    assert len(observed) > 45
    assert caplog.text.count("can never be stored, and was discarded") == 1


def tell_a_fix_of_the_far_future(rig: Rig) -> None:
    """Tell of a fix whose UTC no column can hold: acquisition could not store it either."""
    rig.clock.advance(STEP_S / 2)
    fix = rig.fix()
    rig.tell([replace(fix, stamp=replace(fix.stamp, utc_ns=2**63))])


# ---- callers that leave ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def a_shot_that_waits(rig: Rig) -> Iterator[None]:
    """Another client shoots a control point, whose fixes arrive at the end of the block."""
    shooting = threading.Thread(target=rig.say, args=("shoot",), kwargs={"point": "cp1"})
    shooting.start()
    while rig.keeper.turn.enter_if_free():
        rig.keeper.turn.leave()
        time.sleep(0.01)
    try:
        yield
    finally:
        rig.target_mm = POINT_MM
        while shooting.is_alive():
            rig.live(STEP_S)


@pytest.mark.parametrize("command", ["abort", "stop", "confirm_prism"])
def test_a_command_whose_caller_leaves_while_it_waits_for_a_shot_is_not_carried_out(
    session_rig: Rig, tmp_path: Path, command: str
) -> None:
    began, ended = threading.Event(), threading.Event()

    def carry_out(arguments: Mapping[str, Any]) -> Any:
        began.set()
        try:
            return session_rig.say(command, **arguments)
        finally:
            ended.set()

    session_rig.say("start", prism="r")
    session_rig.live(1)
    server = ControlServer(tmp_path / "s", {command: carry_out})
    try:
        with a_shot_that_waits(session_rig):
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(tmp_path / "s"))
                client.sendall(json.dumps({"command": command}).encode() + b"\n")
                assert began.wait(10)
            assert ended.wait(10), "it does not wait for the end of the shot"
    finally:
        server.close()
    opened = session_rig.keeper.open_session()
    assert opened is not None
    assert opened["state"] == "open"
    assert len(opened["control_shots"]) == 1
    assert table(session_rig.store.path, "prism_confirmations") == []


def test_a_command_that_does_not_wait_is_carried_out_though_its_caller_reads_no_answer(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    with acting_for(None, lambda: True):
        assert session_rig.say("abort")["state"] == "aborted"


def test_a_command_that_has_its_turn_keeps_it_when_its_caller_leaves() -> None:
    turn, has_left = CommandTurn(), threading.Event()
    with acting_for(None, has_left.is_set), turn:
        has_left.set()
        with turn:
            pass
    assert turn.enter_if_free()
