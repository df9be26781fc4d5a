"""What a guide does by itself when the daemon starts again."""

from __future__ import annotations

from calibration.rig.description import parse_rig
from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.guide.course import Course
from daemon.guide.job import Request
from daemon.guide.meter_link import Place
from tests.daemon.support.sessions import SOURCE, Rig, closed_afterwards

rig = closed_afterwards(Rig)


def test_a_guide_whose_session_was_closed_since_is_abandoned_and_says_why(rig: Rig) -> None:
    rig.say("setup_new", id="S1")
    before = course(rig).record
    before.open(Request(("cp1",), ("r",), 6, 0), "S1", "Ada")
    before.happen("opened", {"session": rig.say("start", prism="r")["id"], "last": 0})
    rig.machine = parse_rig(SOURCE.text.replace('name = "r"', 'name = "rod"'), "rig.toml")
    rig.keeper = rig.new_keeper()
    after = course(rig)
    after.restore()
    assert after.record.job is not None
    assert after.record.job.state == "abandoned"
    row = after.record.table.newest()
    assert row is not None
    *_, last = after.record.table.events(row.id)
    assert "the rig file has changed" in last.details["reason"]
    assert rig.say("start", prism="rod")["id"] == "s002-rod"


def course(rig: Rig) -> Course:
    joiner = ObservationJoiner(joint_inputs(rig.machine), signal_inputs(rig.machine), settle_s=0.5)
    return Course(rig.machine, rig.store, rig.keeper, joiner, rig.clock, _no_meter)


def _no_meter() -> Place:
    raise AssertionError("nothing is left to gain")
