"""Which set-up the station stands in: that of what is open, else the one that was described or used last."""

from __future__ import annotations

import pytest

from daemon.alarms.evidence import Evidence
from daemon.alarms.rules.sessions import setup_moved
from daemon.commands import CommandError, acting_for
from daemon.store.queries.guides import GuideTable
from daemon.store.queries.sessions import SessionTable
from daemon.store.queries.setups import SetupRow, SetupTable
from tests.daemon.support.sessions import Rig, controlled

CP1 = (9000.0, 500.0, 2000.0)
MOVED = (9000.0, 600.0, 2000.0)


def alarms(rig: Rig) -> list[tuple[str, str]]:
    """Set-up and severity of the alarms that a set-up has moved, from what the daemon's evidence takes."""
    session, setup = SessionTable(rig.store, "swdt82").open_session(), table(rig).current()
    return [(one.subject, one.severity) for one in setup_moved(Evidence(rig.clock.now(), session=session, setup=setup))]


def table(rig: Rig) -> SetupTable:
    return SetupTable(rig.store, "swdt82")


def described(rig: Rig, name: str) -> None:
    rig.live(1)
    rig.say("setup_new", id=name)
    rig.live(1)


@pytest.fixture
def rig(session_rig: Rig) -> Rig:
    """Its set-up S1 has a control point; S2 was described after it."""
    controlled(session_rig)
    described(session_rig, "S2")
    return session_rig


def test_a_set_up_that_is_used_again_is_watched_though_a_newer_one_is_there(rig: Rig) -> None:
    rig.say("start", prism="r", setup="S1")
    assert (rig.setups.current(), alarms(rig)) == ("S1", [])
    assert rig.shoot("cp1", MOVED)["moved"]
    assert alarms(rig) == [("S1", "critical")]
    assert rig.setups.current() is None, "the tip has no station's frame"
    rig.say("stop")
    assert alarms(rig) == [("S1", "warning")], "nor does the station stand at S2 now"
    assert rig.setups.current() is None
    with pytest.raises(CommandError, match="the current set-up 'S1' has moved"):
        rig.say("start", prism="r")
    described(rig, "S3")
    assert (rig.setups.current(), alarms(rig)) == ("S3", [])


def test_a_newer_set_up_that_has_moved_is_no_fault_of_a_session_elsewhere(rig: Rig) -> None:
    rig.say("start", prism="r")
    rig.shoot("cp1", CP1)
    rig.live(2)
    assert rig.shoot("cp1", MOVED)["moved"]
    rig.say("stop")
    assert alarms(rig) == [("S2", "warning")]
    rig.say("start", prism="r", setup="S1")
    assert (rig.setups.current(), alarms(rig)) == ("S1", [])


def test_the_next_session_is_held_where_the_last_one_was(rig: Rig) -> None:
    assert [one["is_current"] for one in rig.say("setup_list")] == [False, True]
    rig.say("start", prism="r", setup="S1")
    rig.live(1)
    rig.say("stop")
    assert [one["is_current"] for one in rig.say("setup_list")] == [True, False]
    assert rig.say("start", prism="r")["setup"] == "S1"


def test_the_station_stays_where_it_stands_when_the_rig_gets_another_name(rig: Rig) -> None:
    rig.say("start", prism="r", setup="S1")
    rig.live(1)
    rig.say("stop")
    assert SetupTable(rig.store, "renamed").current() == table(rig).current() == SetupRow("S1", "ok")


def test_control_shots_are_those_of_the_set_up_in_use(rig: Rig) -> None:
    assert table(rig).current_shots() == []
    rig.say("start", prism="r", setup="S1")
    rig.shoot("cp1", MOVED)
    (shot,) = table(rig).current_shots()
    assert (shot["setup"], shot["point"], shot["misclosure_mm"]) == ("S1", "cp1", pytest.approx(100.0))


def test_an_open_guide_says_where_the_station_stands(rig: Rig) -> None:
    GuideTable(rig.store, "swdt82").open(rig.clock.now(), "S1", "", {})
    described(rig, "S3")
    assert rig.setups.current() == "S1", "until its first session is open, too"
    GuideTable(rig.store, "ur10").open(rig.clock.now(), "S2", "", {})
    assert rig.setups.current() == "S1", "another rig's says nothing"


def test_a_set_up_that_is_described_while_a_session_is_being_started_is_the_sessions_own(session_rig: Rig) -> None:
    def aim(_target: str) -> None:  # it takes a while, as what tells prisms apart does at the first session
        session_rig.say("setup_new", id="S2")

    session_rig.keeper = session_rig.new_keeper(aim)
    assert session_rig.say("start", prism="r")["setup"] == "S2"
    assert session_rig.setups.current() == "S2"


def test_a_session_is_not_opened_for_a_caller_who_has_left(session_rig: Rig) -> None:
    with acting_for(None, lambda: True), pytest.raises(CommandError, match="its caller has disconnected"):
        session_rig.say("start", prism="r")
    assert session_rig.keeper.open_session() is None


def test_a_control_point_is_none_of_the_prisms(session_rig: Rig) -> None:
    with pytest.raises(CommandError, match="'r' is a prism of the rig"):
        session_rig.say("setup_new", id="S2", control_points={"r": [1.0, 2.0, 3.0]})
    assert [setup["id"] for setup in session_rig.setups.list_command({})] == ["S1"]
