"""Sessions before and after the jump of a joint's encoder, whose zero is then another one."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from daemon.store.queries.models import ModelTable
from daemon.store.queries.sessions import ZERO_LOST, SessionTable
from daemon.store.queries.zeros import Zeros
from daemon.store.upkeep.backup import CLOSE_OPEN_SESSIONS
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.sessions.test_rig_file_changes import change_rig_file
from tests.daemon.support.sessions import SOURCE, Rig, controlled
from tests.daemon.support.store import steps_of

LOST = f"{ZERO_LOST}theta1"


def jump(rig: Rig, device: str = "theta1", degrees: float = 8.2) -> None:
    """Have an encoder jump, as its decoder tells it."""
    rig.clock.advance(1.0)
    event = DeviceEvent(device, rig.clock.now(), EventKind.PRESET_JUMP, "position jumped")
    if device in rig.values:
        rig.values[device] += degrees
    rig.store.insert_records([event])
    rig.tell([event])
    rig.clock.advance(1.0)


def used(rig: Rig) -> list[str]:
    return [row["id"] for row in SessionTable(rig.store, SOURCE.rig.name).used()]


def check_zeros(rig: Rig, trained_on: str) -> None:
    """Give an operator's word that the zeros are those of a live model that was trained on a session."""
    now = rig.store.instant(rig.clock.now(), "created_")
    done = {"kind": "identification", "state": "done", "result_json": {"sessions": [trained_on]}}
    made = {"rig": SOURCE.rig.name, "path": "", "manifest_sha256": "", "stage": "geometric", "state": "live"}
    model = rig.store.insert("models", made | {"job_id": rig.store.insert("jobs", done | now)} | now)
    through = rig.store.number("SELECT max(id) FROM device_events", ())
    word = {"model_id": model, "state": "live", "reason": "zeros checked", "zeros_checked_through": through}
    rig.store.insert("model_states", word | rig.store.instant(rig.clock.now()))
    rig.keeper.zeros_checked()


def test_sessions_before_and_after_a_jump_are_not_calibrated_together(session_rig: Rig) -> None:
    before = controlled(session_rig)
    jump(session_rig)
    assert used(session_rig) == []
    assert session_rig.say("show", id=before)["not_used"] == LOST
    sessions = SessionTable(session_rig.store, SOURCE.rig.name)
    assert sessions.zeros_lost() == ["theta1"], "somebody must look at it, also where no model is live"
    assert sessions.untrained() == {}
    after = controlled(session_rig)
    assert used(session_rig) == [after]
    assert sessions.zeros_lost() == []


def test_a_session_that_is_started_after_a_jump_ends_the_alarm_of_it_and_one_that_was_aborted_does_not_count(
    session_rig: Rig,
) -> None:
    sessions = SessionTable(session_rig.store, SOURCE.rig.name)
    session_rig.say("start", prism="r")
    jump(session_rig)
    assert sessions.zeros_lost() == ["theta1"]
    session_rig.say("abort")
    assert sessions.zeros_lost() == []
    before = controlled(session_rig)
    jump(session_rig)
    assert sessions.zeros_lost() == ["theta1"]
    session_rig.say("start", prism="s")
    assert sessions.zeros_lost() == []
    session_rig.say("abort")
    assert sessions.zeros_lost() == ["theta1"], "of the session before"
    session_rig.say("reject", id=before)
    assert sessions.zeros_lost() == []


def test_an_operator_who_accepts_a_session_is_told_of_every_joint_that_has_jumped_since(session_rig: Rig) -> None:
    before = controlled(session_rig)
    jump(session_rig)
    jump(session_rig, "theta3")
    assert session_rig.say("show", id=before)["not_used"] == f"{LOST}, theta3"
    session_rig.say("accept", id=before)
    assert session_rig.say("show", id=before)["accepted"]["despite"] == f"{LOST}, theta3"


def test_a_session_in_which_an_encoder_jumps_is_not_calibrated_with_the_one_that_is_begun_anew(
    session_rig: Rig,
) -> None:
    first = session_rig.say("start", prism="r")["id"]
    session_rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    session_rig.live(2)
    jump(session_rig)
    session_rig.live(1)
    assert session_rig.keeper.open_session()["jumped"] == ["theta1"]  # type: ignore[index]
    session_rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    ended = session_rig.say("stop")
    assert ended["not_used"] == LOST
    assert any("start a new session" in sentence for sentence in ended["advice"])
    second = controlled(session_rig)
    assert used(session_rig) == [second] != [first]
    session_rig.keeper = session_rig.new_keeper()  # as a daemon that was started again
    assert used(session_rig) == [second]


def test_a_jump_of_something_that_is_no_joint_takes_no_session_away(session_rig: Rig) -> None:
    name = controlled(session_rig)
    jump(session_rig, "boom_valve")
    assert used(session_rig) == [name]


def test_an_operators_word_about_the_zeros_brings_back_the_sessions_of_the_live_model(session_rig: Rig) -> None:
    before = controlled(session_rig)
    jump(session_rig)
    session_rig.values["theta1"] -= 8.2
    after = controlled(session_rig)
    check_zeros(session_rig, before)
    assert used(session_rig) == [before, after]
    jump(session_rig)
    assert used(session_rig) == []


def test_a_session_between_a_lost_zero_and_its_being_set_back_stays_out(session_rig: Rig) -> None:
    before = controlled(session_rig)
    jump(session_rig)
    between = controlled(session_rig)
    jump(session_rig, degrees=-8.2)  # the preset that sets it back is a jump as well
    check_zeros(session_rig, before)
    after = controlled(session_rig)
    assert used(session_rig) == [before, after]
    assert session_rig.say("show", id=between)["not_used"] == LOST


def test_an_accepted_session_is_used_until_the_next_jump(session_rig: Rig) -> None:
    name = controlled(session_rig)
    jump(session_rig)
    session_rig.say("accept", id=name, operator="Ada")
    assert used(session_rig) == [name]
    assert SessionTable(session_rig.store, SOURCE.rig.name).zeros_lost() == [], "so that the alarm ends"
    session_rig.keeper = session_rig.new_keeper()
    assert used(session_rig) == [name]
    jump(session_rig)
    assert used(session_rig) == []


def test_a_word_about_a_model_that_is_newer_than_all_jumps_changes_nothing(session_rig: Rig) -> None:
    early = session_rig.clock.now()
    jump(session_rig)
    name = controlled(session_rig)
    check_zeros(session_rig, name)
    assert list(Zeros(session_rig.store, SOURCE.rig.name).lost(early)) == ["theta1"]


def test_a_session_says_all_that_speaks_against_it(session_rig: Rig) -> None:
    session_rig.say("start", prism="r")
    session_rig.live(2)
    session_rig.say("stop")
    jump(session_rig)
    told = session_rig.say("list")[0]["not_used"]
    assert told.startswith(f"{LOST}; no control point was shot")


@pytest.mark.parametrize("is_of_backup", [False, True])
def test_a_session_that_was_left_open_is_not_used_after_zeros_were_lost_and_checked(
    session_rig: Rig, is_of_backup: bool
) -> None:
    store, clock = session_rig.store, session_rig.clock
    name = str(session_rig.say("start", prism="r")["id"])
    for _ in range(2):
        session_rig.shoot("cp1", (9000.0, 500.0, 2000.0))
        session_rig.live(2)
    if is_of_backup:
        with store.transaction() as db:
            db.execute(CLOSE_OPEN_SESSIONS)
    else:
        store.note_alive(clock.now())
        clock.advance(86_400)
        store.begin_run(clock.now())
        row = {"id": "later", "rig": "boom7", "prism": "b", "operator": "", "kind": "static_poses", "state": "closed"}
        at = store.instant(clock.now(), "started_") | store.instant(clock.now(), "ended_")
        store.insert("calibration_sessions", row | at)
    change_rig_file(session_rig, SOURCE.rig)
    why = session_rig.say("show", id=name)["not_used"]
    assert "was open in the backup" in why or "still open when session later was started" in why
    after = controlled(session_rig)
    jump(session_rig)
    assert session_rig.say("show", id=name)["not_used"].startswith(f"{LOST}; {why}")
    check_zeros(session_rig, after)
    assert why in session_rig.say("show", id=name)["not_used"]
    assert used(session_rig) == [after]


# ---- what it costs ---------------------------------------------------------------------------------------------------


def flap(rig: Rig, times: int) -> None:
    """Have an encoder with a loose contact jump at so many frames."""
    events = []
    for _ in range(times):
        rig.clock.advance(0.05)
        events.append(DeviceEvent("theta4", rig.clock.now(), EventKind.PRESET_JUMP, "position jumped"))
    rig.store.insert_records(events)


def test_an_encoder_that_jumps_at_every_frame_costs_no_more_after_many_jumps(session_rig: Rig) -> None:
    name, store = controlled(session_rig), session_rig.store
    jump(session_rig, "theta4", 0.0)
    check_zeros(session_rig, name)
    (row,) = store.rows("SELECT * FROM calibration_sessions")
    with store.transaction():
        for number in range(299):
            store.insert("calibration_sessions", row | {"id": f"copy {number}"})
    session_rig.say("start", prism="r")
    (opened,) = session_rig.keeper._taking()[-1:]
    sessions, models = SessionTable(store, SOURCE.rig.name), ModelTable(store, SOURCE.rig.name, session_rig.clock)
    model = models.live()
    assert model is not None
    looks: dict[str, Callable[[], object]] = {
        "a jump is stored": lambda: jump(session_rig, "theta4", 0.0),
        "alarms": lambda: (sessions.open_session(), sessions.zeros_lost()),
        "the live model": lambda: models.jumped(model),
        "a start or a located point": lambda: session_rig.keeper._prisms._evidence(opened),
        "a restart": session_rig.new_keeper,
    }
    jump(session_rig, "theta4", 0.0)  # which takes all sessions away
    few = {name: steps_of(store, look) for name, look in looks.items()}
    flap(session_rig, 20_000)
    many = {name: steps_of(store, look) for name, look in looks.items()}
    assert all(many[name] <= 1.05 * few[name] + 500 for name in looks), (few, many)
    assert many["a jump is stored"] < 50_000, "of 300 closed sessions"
    assert sessions.zeros_lost() == ["theta4"]
    assert used(session_rig) == []
    store.update("models", {"id": model.id}, {"state": "retired"})
    check_zeros(session_rig, name)
    assert steps_of(store, looks["alarms"]) <= few["alarms"] + 500, "although an earlier word is asked for"
    assert sessions.zeros_lost() == [] == [*models.jumped(model)]
    assert not session_rig.say("show", id="copy 7")["not_used"].startswith(ZERO_LOST)
