"""Sessions whose readings were made with another rig file than the one in use."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from calibration.errors import DataError
from calibration.rig.description import Rig as Machine
from calibration.rig.description import parse_rig
from daemon.commands import CommandError
from daemon.report.words import not_used
from daemon.rig_files import load_rig, misreading
from daemon.sessions.session_data import sessions_csv
from daemon.store.queries.sessions import SessionTable
from daemon.store.upkeep.retention import LAST, free_stretches
from rigcal.store_api import open_store
from tests.daemon.support.rig_files import ANOTHER_FACTOR, ANOTHER_LENGTH, ANOTHER_ZERO, L2, decoded_rig, own_rig
from tests.daemon.support.sessions import SOURCE, Rig, controlled

ANOTHER_NODE = (L2, L2.replace("48", "58"))
OTHER_TIMES = (L2, f"{L2}heartbeat_ms = 500\ntimeout_s = 3.0\n")
ANOTHER_NAME = ("theta8", "roll8")
WIDER = ("limits = [0, 2168]", "limits = [0, 2200]")


def other(old: str, new: str) -> Machine:
    assert old in SOURCE.text
    return parse_rig(SOURCE.text.replace(old, new), "rig")


def change_rig_file(rig: Rig, machine: Machine) -> None:
    """Go on as a daemon that was started again with another rig file."""
    rig.machine = machine
    rig.keeper = rig.new_keeper()


def used(rig: Rig) -> list[str]:
    return [row["id"] for row in SessionTable(rig.store, SOURCE.rig.name).used()]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (ANOTHER_ZERO, "its channel L2 has zero_counts = 0, this one -2000"),
        (ANOTHER_NAME, "it has no joint roll8"),
        (('name = "r"', 'name = "front"'), "it has a prism r, this one has none"),
        (ANOTHER_NODE, "its channel L2 has node = 48, this one 58"),
        (OTHER_TIMES, ""),
        (WIDER, ""),
    ],
    ids=["zero", "name", "prism", "node", "times", "limits"],
)
def test_only_what_decides_the_meaning_of_a_reading_makes_another_rig_file(change: tuple[str, str], why: str) -> None:
    assert misreading(other(*change), SOURCE.text, "r") == why


def test_sessions_of_another_rig_file_are_not_calibrated_together(session_rig: Rig) -> None:
    before = controlled(session_rig)
    change_rig_file(session_rig, other(*ANOTHER_ZERO))
    assert used(session_rig) == []
    after = controlled(session_rig)
    assert used(session_rig) == [after]
    told = session_rig.say("show", id=before)
    assert told["not_used"] == (
        "it was recorded with another rig file: its channel L2 has zero_counts = 0, this one -2000"
    )
    assert told["no_job"] is None or told["not_used"] in told["no_job"]
    assert SessionTable(session_rig.store, SOURCE.rig.name).untrained() == {}, "history is no alarm"


@pytest.mark.parametrize("changed", ["dbc", "eds"])
def test_sessions_from_before_and_after_a_changed_dbc_or_eds_file_are_not_calibrated_together(
    session_rig: Rig, tmp_path: Path, changed: str
) -> None:
    change_rig_file(session_rig, decoded_rig(tmp_path).rig)
    before = controlled(session_rig)
    if changed == "dbc":
        channel, after_change = "pump", decoded_rig(tmp_path, dbc=ANOTHER_FACTOR).rig
    else:
        channel, after_change = "theta1", decoded_rig(tmp_path, eds=ANOTHER_LENGTH).rig
    change_rig_file(session_rig, after_change)
    assert used(session_rig) == []
    after = controlled(session_rig)
    assert used(session_rig) == [after]
    why = f"another rig file: its channel {channel} is decoded as "
    assert why in session_rig.say("show", id=before)["not_used"]
    with contextlib.closing(session_rig.store.reader()) as reader, pytest.raises(DataError, match=why):
        sessions_csv(reader, session_rig.machine, [before, after])


def test_an_unrelated_change_of_a_dbc_file_keeps_its_sessions(session_rig: Rig, tmp_path: Path) -> None:
    change_rig_file(session_rig, decoded_rig(tmp_path).rig)
    name = controlled(session_rig)
    change_rig_file(
        session_rig, decoded_rig(tmp_path, dbc=("SG_ ErrFlags : 60|4@1+ (1,0)", "SG_ Flags : 61|3@1+ (2,0)")).rig
    )
    assert used(session_rig) == [name]


def test_sessions_from_before_decodings_were_stored_are_used_on(session_rig: Rig, tmp_path: Path) -> None:
    change_rig_file(session_rig, own_rig(tmp_path).rig)
    name = controlled(session_rig)
    open_one = session_rig.say("start", prism="r")["id"]
    change_rig_file(session_rig, decoded_rig(tmp_path).rig)
    assert used(session_rig) == [name]
    assert [s["state"] for s in session_rig.say("list") if s["id"] == open_one] == ["open"], "it is the same file"


def test_sessions_count_again_as_soon_as_their_rig_file_is_back(session_rig: Rig) -> None:
    held, unheld = controlled(session_rig), str(session_rig.say("start", prism="r")["id"])
    session_rig.live(2)
    session_rig.say("stop")
    session_rig.say("accept", id=unheld)
    change_rig_file(session_rig, other(*ANOTHER_NAME))
    assert used(session_rig) == []
    change_rig_file(session_rig, SOURCE.rig)
    assert used(session_rig) == [held, unheld]


def test_a_rig_file_that_reads_alike_keeps_its_sessions(session_rig: Rig) -> None:
    name = controlled(session_rig)
    change_rig_file(session_rig, other(*WIDER))
    assert used(session_rig) == [name]


def test_no_word_of_an_operator_makes_readings_of_another_rig_file_good(session_rig: Rig) -> None:
    name = controlled(session_rig)
    change_rig_file(session_rig, other(*ANOTHER_ZERO))
    with pytest.raises(CommandError, match=r"another rig file.*`rigcal replay`") as caught:
        session_rig.say("accept", id=name)
    assert caught.value.status == 3
    told = not_used(name, session_rig.say("show", id=name)["not_used"])
    assert "`rigcal replay`" in told
    assert "session accept" not in told, "it would be refused"


def test_data_of_two_rig_files_are_refused_wherever_they_are_read(session_rig: Rig) -> None:
    before = controlled(session_rig)
    change_rig_file(session_rig, other(*ANOTHER_NAME))
    after = controlled(session_rig)
    # Nothing reads roll8, so no fix between its shots counts; here it is used all the same
    SessionTable(session_rig.store, session_rig.machine.name).change(after, excluded=None)
    why = f"session {before}: it was recorded with another rig file: it has no joint roll8"
    with contextlib.closing(session_rig.store.reader()) as reader, pytest.raises(DataError, match=why):
        sessions_csv(reader, session_rig.machine, [before, after])
    with open_store(session_rig.store.path) as store:
        for order in ([before, after], [after, before]):
            with pytest.raises(DataError, match=why):
                store.training_data(order)
        rig, rows = store.training_data([before])
        assert "theta8" in rig.joint_names
        assert len(rows) > 0


RENAMED = ('name = "swdt82"', 'name = "boom7"')


def test_a_session_left_open_is_closed_when_the_rig_is_renamed(session_rig: Rig) -> None:
    name = str(session_rig.say("start", prism="r")["id"])
    session_rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    session_rig.live(2)
    session_rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    change_rig_file(session_rig, other(*RENAMED))
    closed = session_rig.say("show", id=name)
    assert closed["state"] == "closed"
    assert closed["note"] == "closed by rigcal: the rig was changed from swdt82 to boom7 while it was open"
    assert closed["not_used"] is None, "its control point shows that the station stood still"
    session_rig.clock.advance(3600)
    assert [end for _, end in free_stretches(session_rig.store)][-1] == LAST, "what is captured from now on may go"
    session_rig.say("start", prism="b")
    session_rig.live(2)
    session_rig.say("stop")
    change_rig_file(session_rig, SOURCE.rig)
    assert session_rig.keeper.open_session() is None, "it does not go on with a station that has been elsewhere"
    assert used(session_rig) == [name]


def test_a_session_of_a_different_machine_left_open_is_closed_and_can_be_accepted_once_that_is_back(
    session_rig: Rig,
) -> None:
    name = str(session_rig.say("start", prism="r")["id"])
    session_rig.live(2)
    change_rig_file(session_rig, load_rig("ur10").rig)
    assert "another rig file" in session_rig.say("show", id=name)["not_used"]
    change_rig_file(session_rig, SOURCE.rig)
    session_rig.say("accept", id=name)
    assert used(session_rig) == [name]


def test_a_session_that_an_older_version_left_open_ends_with_the_run_that_measured_in_it(session_rig: Rig) -> None:
    store, clock = session_rig.store, session_rig.clock
    name = str(session_rig.say("start", prism="r")["id"])
    session_rig.live(2)
    store.note_alive(clock.now())
    measured = clock.now()
    clock.advance(30 * 86_400)  # a month with another rig
    store.begin_run(clock.now())
    row = {"id": "later", "rig": "boom7", "prism": "b", "operator": "", "kind": "static_poses", "state": "closed"}
    store.insert(
        "calibration_sessions", row | store.instant(clock.now(), "started_") | store.instant(clock.now(), "ended_")
    )
    change_rig_file(session_rig, SOURCE.rig)
    closed = session_rig.say("show", id=name)
    assert (closed["state"], closed["ended_utc_ns"]) == ("closed", measured.utc_ns)
    assert closed["not_used"] == "it was still open when session later was started"
    assert len([*free_stretches(store)]) == 3, "before, between and after the two"
