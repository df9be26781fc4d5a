"""A guide whose daemon is restarted, and a gain meter whose answer cannot be stored."""

from __future__ import annotations

import pytest

from daemon.guide.meter_link import Place
from daemon.host.ended_threads import EndedThreads
from tests.daemon.guide.test_guide_gain_meter import CHOOSES, meter_that
from tests.daemon.guide.test_guide_warnings import WatchedRig
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.sessions import closed_afterwards, disk_fails

rig = closed_afterwards(WatchedRig)


def test_a_restart_while_the_station_is_turned_to_a_prism_suspects_nothing(rig: WatchedRig) -> None:
    rig.after_the_point()  # the guide waits for the station to be aimed at a prism
    for y_mm in (8000.0, 14_000.0, 3000.0):  # the station locks on to what it passes
        rig.target_mm = (3000.0, y_mm, 1000.0)
        rig.live(2)
    assert rig.keeper.prism_suspicions() == []
    rig.restarted()
    assert rig.keeper.prism_suspicions() == []


def test_an_answer_of_the_gain_meter_that_cannot_be_stored_ends_no_thread(
    rig: WatchedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with EndedThreads() as ended:
        meter_that(CHOOSES, monkeypatch)
        advisor = rig.guide._course.advisor
        advisor._place = lambda: Place("rigcal.sqlite", None, "")
        rig.at_a_pose(poses=6)
        with disk_fails():
            rig.guide._worker._look()  # asks for poses
            wait_until(lambda: advisor._meter is not None and not advisor.is_alive)
        rig.guide._worker._look()  # starts the meter again
        wait_until(lambda: rig.guide.state_command({})["guide"]["step"]["kind"] != "planning")
        rig.guide.stop()
    assert ended.found() == {}
