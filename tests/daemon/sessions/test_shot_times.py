"""Fixes of a control point never become the prism's, though rigcal is killed before the point's place is known."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from daemon.config.sections import SessionsSection
from drivers.readings import EventKind
from tests.daemon.sessions.test_prism_watch import PRISM_MM, used
from tests.daemon.support.acquisition import wait_until
from tests.daemon.support.sessions import STEP_S, Rig, closed_afterwards, start
from tests.daemon.support.store import table

CONTROL_MM = (9000.0, 500.0, 2000.0)

rig = closed_afterwards(Rig)


@pytest.fixture
def restarted(rig: Rig, tmp_path: Path) -> Iterator[Rig]:
    """A rig whose daemon was killed during the first shot of a control point, and runs again."""
    start(rig)
    rig.live(2)
    rig.keeper._settings = SessionsSection(fixes_per_shot=60)
    shooting = threading.Thread(target=rig.say, args=("shoot",), kwargs={"point": "cp1"})
    shooting.start()
    wait_until(lambda: rig.keeper._shot is not None)
    rig.target_mm = CONTROL_MM
    rig.live(2)
    path = tmp_path / "killed.sqlite"
    with closing(sqlite3.connect(rig.store.path)) as running, closing(sqlite3.connect(path)) as killed:
        running.backup(killed)
    while shooting.is_alive():
        rig.live(STEP_S)
    made = Rig(path)
    made.clock.set(rig.clock.now())
    made.target_mm = CONTROL_MM
    made.keeper = made.new_keeper()
    yield made
    made.store.close()


def test_fixes_after_a_kill_in_a_shot_are_not_of_the_prism_until_an_operator_confirms_it(restarted: Rig) -> None:
    restarted.live(3)
    before = used(restarted)
    assert set(before) == {8000}
    (suspicion,) = restarted.keeper.prism_suspicions()
    assert suspicion.reason == "perhaps another prism: rigcal ended while the station was on a control point"
    opened = restarted.keeper.open_session()
    assert opened is not None
    assert [one["text"] for one in opened["prism_suspicions"]] == [suspicion.reason]
    restarted.target_mm = PRISM_MM
    restarted.live(1)
    restarted.say("confirm_prism", operator="Ada")
    assert restarted.keeper.prism_suspicions() == []
    restarted.live(2)
    assert set(used(restarted)) == {8000}
    assert len(used(restarted)) > len(before) + 20


def test_a_shot_that_is_repeated_after_a_kill_shows_where_the_station_is(restarted: Rig) -> None:
    restarted.live(3)
    before = used(restarted)
    assert restarted.shoot("cp1", CONTROL_MM)["misclosure_mm"] is None
    assert restarted.keeper.prism_suspicions() == []
    restarted.live(1)
    restarted.target_mm = PRISM_MM
    restarted.keeper = restarted.new_keeper()
    restarted.live(3)
    assert restarted.keeper.prism_suspicions() == []
    assert set(used(restarted)) == {8000}
    assert len(used(restarted)) > len(before) + 20


def test_a_program_that_aims_turns_the_station_back_after_a_kill_in_a_shot(restarted: Rig) -> None:
    before = used(restarted)
    restarted.target_mm = PRISM_MM
    restarted.keeper = restarted.new_keeper(aim=restarted.aimed.append)
    assert restarted.aimed == ["r"]
    assert restarted.keeper.prism_suspicions() == []
    restarted.live(3)
    assert set(used(restarted)) == {8000}
    assert len(used(restarted)) > len(before) + 20


def test_the_beginning_and_the_end_of_a_shot_are_events_of_the_station(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", CONTROL_MM)
    told = [(row["device"], row["kind"], row["text"]) for row in table(rig.store.path, "device_events")]
    assert told == [
        ("station", EventKind.SHOT_BEGUN, "shot of control point cp1 begun"),
        ("station", EventKind.SHOT_ENDED, "shot of control point cp1 ended"),
    ]
