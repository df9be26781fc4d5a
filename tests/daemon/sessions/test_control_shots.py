import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.commands import CommandError
from daemon.config.sections import SessionsSection
from daemon.control.server import ControlServer
from daemon.sessions.manager import SessionManager
from daemon.sessions.session_data import setup_lines
from daemon.store.queries.observations import OF_CONTROL_POINT
from daemon.store.reader import Reader
from drivers.readings import Record
from tests.daemon.support.sessions import STEP_S, Rig, closed_afterwards, start

rig = closed_afterwards(Rig)


def test_control_points_that_hold_say_so(rig: Rig) -> None:
    start(rig)
    assert rig.shoot("cp1", (9000.0, 500.0, 2000.0))["misclosure_mm"] is None
    rig.live(2)
    again = rig.shoot("cp1", (9000.0, 502.0, 2000.0))
    assert again["phase"] == "end"
    assert again["misclosure_mm"] == pytest.approx(2.0, abs=1e-6)
    assert not again["moved"]
    assert rig.keeper.open_session() is not None
    summary = rig.say("stop")
    assert not summary["setup_moved"]
    with Reader(rig.store.path) as reader:
        (line,) = setup_lines(reader, ["s001-r"])
    assert line.control_points[0].end_mm == pytest.approx((0.0, 2.0, 0.0), abs=1e-6)


def test_a_setup_that_moved_is_flagged_and_refused_from_then_on(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.live(2)
    assert rig.shoot("cp1", (9000.0, 520.0, 2000.0))["moved"]
    assert rig.say("stop")["setup_moved"]
    assert rig.say("setup_list")[0]["state"] == "moved"
    with pytest.raises(CommandError, match="set-up 'S1' has moved") as caught:
        rig.say("start", prism="r", setup="S1")
    assert caught.value.status == 3
    with pytest.raises(CommandError, match="the current set-up 'S1' has moved; describe a new one"):
        rig.say("start", prism="r")


def test_fixes_on_a_control_point_are_no_observations(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.target_mm = (9000.0, 500.0, 2000.0)
    rig.live(2)
    summary = rig.say("stop")
    assert summary["observations"] == 0
    assert summary["excluded"]["a control point, not the prism"] > 10


def test_fixes_on_a_control_point_before_its_first_shot_are_no_observations(rig: Rig) -> None:
    """Its place is not known yet while they come: the operator aims first, and gives the commands then."""
    rig.target_mm = (9000.0, 500.0, 2000.0)
    start(rig)
    rig.live(3)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.live(1, theta1=5.0)
    rig.target_mm = (3000.0, 8000.0, 1000.0)
    rig.live(3)
    summary = rig.say("stop")
    kept = rig.store.rows("SELECT x_mm FROM observations WHERE excluded IS NULL")
    assert {round(row["x_mm"]) for row in kept} <= {3000}
    assert summary["excluded"]["a control point, not the prism"] > 10


class OvertakenJoiner(ObservationJoiner):
    """Joins as usual; when a shot has its fixes, what was joined is stored only after that of the command."""

    keeper: SessionManager

    def feed(self, records: Iterable[Record]) -> Any:
        yield from super().feed(records)
        while (shot := self.keeper._shot) is not None and shot.done.done():
            time.sleep(0.001)


def test_a_shot_that_ends_between_the_making_of_an_observation_and_its_storing_excludes_it(rig: Rig) -> None:
    rig.target_mm = (9000.0, 500.0, 2000.0)
    joiner = OvertakenJoiner(joint_inputs(rig.machine), signal_inputs(rig.machine), settle_s=0.5)
    joiner.keeper, rig.keeper._joiner = rig.keeper, joiner
    start(rig)
    rig.live(3)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    summary = rig.say("stop")
    assert summary["observations"] == 0
    assert summary["excluded"]["a control point, not the prism"] > 10


def test_a_control_point_that_is_not_there_is_told(rig: Rig) -> None:
    start(rig)
    rig.keeper._settings = SessionsSection(fixes_per_shot=10_000, shot_timeout_s=1.0)
    with pytest.raises(CommandError, match="of 10000 good fixes within 1 s; check with"):
        rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.keeper._why_no_fix = AcquisitionStatus(error="the disk is full").why_no_fix
    with pytest.raises(CommandError, match="good fixes within 1 s; nothing can be stored: the disk is full"):
        rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    with pytest.raises(CommandError, match="'r' is a prism of the rig"):
        rig.say("shoot", point="r")


def test_a_control_point_is_not_defined_or_measured_where_another_one_is(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    with pytest.raises(CommandError, match="the station is on control point cp1, not on cp2, and nothing was stored"):
        rig.shoot("cp2", (9000.0, 500.0, 2000.0))
    rig.shoot("cp2", (9000.0, 5000.0, 2000.0))
    rig.live(2)
    with pytest.raises(CommandError, match="on control point cp2, not on cp1"):
        rig.shoot("cp1", (9000.0, 5000.0, 2000.0))
    assert not rig.shoot("cp1", (9000.0, 500.0, 2000.0))["moved"]


def test_a_shot_that_the_operator_gave_up_measures_nothing(rig: Rig, tmp_path: Path) -> None:
    """Who gives up turns the station back to the prism, whose fixes were then taken for the control point."""
    start(rig)
    rig.keeper._settings = SessionsSection(fixes_per_shot=40)
    server = ControlServer(tmp_path / "socket", {"session.shoot": rig.keeper.shoot_command})
    try:
        with socket.socket(socket.AF_UNIX) as operator:
            operator.connect(str(tmp_path / "socket"))
            operator.sendall(b'{"command": "session.shoot", "arguments": {"point": "cp1"}}\n')
            while rig.keeper._shot is None:
                rig.live(STEP_S)
        while rig.keeper._shot is not None:
            rig.live(STEP_S)
    finally:
        server.close()
    assert rig.say("setup_list")[0]["control_points"] == []
    rig.live(2)
    assert rig.say("stop")["control_shots"] == []


def test_where_something_can_aim_it_is_told_to(rig: Rig) -> None:
    rig.keeper = rig.new_keeper(aim=rig.aimed.append)
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    assert rig.aimed == ["r", "cp1", "r"]
    rig.new_keeper(aim=rig.aimed.append)
    assert rig.aimed == ["r", "cp1", "r", "r"], "a session that goes on after a restart is aimed for again"


def test_a_shot_repeated_at_the_start_replaces_the_one_before(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    again = rig.shoot("cp1", (9000.0, 620.0, 2000.0))
    assert again["misclosure_mm"] is None
    assert rig.say("setup_list")[0]["control_points"][0]["y_mm"] == pytest.approx(620.0)


def test_a_first_shot_that_was_made_on_the_prism_is_undone_by_its_repetition(rig: Rig) -> None:
    start(rig)
    rig.live(3)
    rig.shoot("cp1", rig.target_mm)
    assert rig.keeper.open_session()["observations"] == 0  # type: ignore[index]
    assert rig.shoot("cp1", (9000.0, 500.0, 2000.0))["misclosure_mm"] is None
    rig.live(1)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    summary = rig.say("stop")
    assert summary["observations"] > 50, "but for fixes that waited for their joints during the shot"
    assert set(summary["excluded"]) <= {"moving", OF_CONTROL_POINT}
    assert summary["not_used"] is None


def test_a_repeated_first_shot_gives_back_no_fix_of_another_prism(rig: Rig) -> None:
    start(rig)
    rig.live(3)
    rig.target_mm = (3000.0, 18000.0, 1000.0)
    rig.live(2)
    rig.shoot("cp1", rig.target_mm)
    rig.live(1)  # fixes that waited for their joints during the shot
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rows = rig.store.rows("SELECT y_mm FROM observations WHERE excluded IS NULL")
    assert {round(row["y_mm"]) for row in rows} == {8000}


def test_a_control_point_that_only_an_aborted_session_has_located_is_unknown(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", rig.target_mm)
    rig.say("abort")
    assert rig.say("setup_list")[0]["control_points"] == []
    rig.say("start", prism="r")
    rig.live(2)
    assert rig.keeper.open_session()["observations"] > 20  # type: ignore[index]
    assert rig.shoot("cp1", (9000.0, 620.0, 2000.0))["misclosure_mm"] is None
    assert rig.shoot("cp1", (9000.0, 500.0, 2000.0))["misclosure_mm"] is None
    rig.live(1)
    end = rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    assert (end["misclosure_mm"], end["moved"]) == (pytest.approx(0.0, abs=1e-6), False)
    assert rig.say("stop")["observations"] > 40
    assert rig.say("setup_list")[0]["state"] == "ok"


def test_a_control_point_of_known_place_stays_known_after_an_aborted_session(rig: Rig) -> None:
    rig.say("setup_new", id="S1", control_points={"cp1": [9000.0, 500.0, 2000.0]})
    rig.say("start", prism="r")
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.say("abort")
    rig.say("start", prism="r")
    assert rig.shoot("cp1", (9000.0, 503.0, 2000.0))["misclosure_mm"] == pytest.approx(3.0, abs=1e-6)


def test_a_control_point_of_known_place_is_held_against_it_from_the_first_shot(rig: Rig) -> None:
    rig.say("setup_new", id="S1", control_points={"cp1": [9000.0, 500.0, 2000.0]})
    rig.say("start", prism="r")
    shot = rig.shoot("cp1", (9000.0, 503.0, 2000.0))
    assert shot["phase"] == "start"
    assert shot["misclosure_mm"] == pytest.approx(3.0, abs=1e-6)


def test_a_fix_of_the_prism_never_becomes_the_control_point(rig: Rig) -> None:
    """While something aims back at the prism, fixes go on; the shot was complete before."""
    rig.keeper = rig.new_keeper(aim=lambda target: rig.live(1) if target == "r" else None)
    start(rig)
    shot = rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    assert (shot["x_mm"], shot["y_mm"]) == pytest.approx((9000.0, 500.0))
