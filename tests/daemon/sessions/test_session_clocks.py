import numpy as np
import pytest

from calibration.observations import parse_observations
from daemon.cli.lines.state import show_session
from daemon.host.time_service import ClockState
from daemon.sessions.session_data import sessions_csv
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig, closed_afterwards, start

rig = closed_afterwards(Rig)


def test_a_clock_that_is_set_in_a_session_does_not_step_its_times(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    now = rig.clock.now()
    rig.clock.set(Stamp(now.utc_ns - 86_400 * NS_PER_S, now.monotonic_ns, now.boot_id))
    rig.live(2)
    rig.say("stop")
    with Reader(rig.store.path) as reader:
        table = parse_observations(sessions_csv(reader, SOURCE.rig, ["s001-r"]), SOURCE.rig, "a session")
    assert np.diff(table.extra["time_s"]) == pytest.approx(STEP_S)
    assert table.extra["time_s"][-1] > 2.0


@pytest.mark.parametrize(("step_s", "backwards"), [(-3600.0, True), (-0.2, True), (3600.0, False)])
def test_a_session_whose_clock_was_set_is_flagged(rig: Rig, step_s: float, backwards: bool) -> None:
    start(rig)
    rig.live(2)
    now = rig.clock.now()
    rig.clock.set(Stamp(now.utc_ns + round(step_s * NS_PER_S), now.monotonic_ns, now.boot_id))
    rig.live(2)
    stopped = rig.say("stop")
    for told in (stopped, rig.say("show", id="s001-r"), *rig.say("list")):
        assert told["utc_ran_backwards"] is backwards
        (step,) = told["clock_steps"]
        assert step["step_s"] == pytest.approx(step_s)
        assert step["at_utc_ns"] == now.utc_ns + round((step_s + STEP_S) * NS_PER_S)
    advice = [sentence for sentence in stopped["advice"] if "clock was set back" in sentence]
    assert len(advice) == backwards


def test_status_shows_steps_of_the_clock_that_go_back_to_where_it_was(rig: Rig) -> None:
    start(rig)
    shown = []
    for step_s in (10, -10, 10):
        rig.live(2)
        now = rig.clock.now()
        rig.clock.set(Stamp(now.utc_ns + step_s * NS_PER_S, now.monotonic_ns, now.boot_id))
        rig.live(2)
        opened = rig.keeper.open_session()
        assert opened is not None
        shown.append([round(step["step_s"]) for step in opened["clock_steps"]])
    assert shown == [[10], [10, -10], [10, -10, 10]]


def test_a_session_that_goes_on_after_a_boot_with_an_earlier_clock_is_flagged(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    now = rig.clock.now()
    rig.clock.set(Stamp(now.utc_ns - 86_400 * NS_PER_S, 5 * NS_PER_S, "next boot"))
    rig.keeper = rig.new_keeper()
    rig.live(2)
    assert rig.say("stop")["utc_ran_backwards"]
    rig.clock.set(Stamp(now.utc_ns + 86_400 * NS_PER_S, 5 * NS_PER_S, "a boot with a clock that is right"))
    rig.say("start", prism="r")
    rig.live(2)
    assert rig.say("stop")["clock_steps"] == []


@pytest.mark.parametrize("boot", ["", "next boot"])
def test_a_session_before_which_the_clock_was_set_back_is_flagged(rig: Rig, boot: str) -> None:
    start(rig)
    rig.live(2)
    rig.say("stop")
    ended = rig.clock.now()
    rig.clock.set(Stamp(ended.utc_ns - 3600 * NS_PER_S, ended.monotonic_ns, boot or ended.boot_id))
    rig.say("start", prism="r")
    rig.live(2)
    told = rig.say("stop")
    assert told["clock_steps"] == [{"at_utc_ns": ended.utc_ns - 3600 * NS_PER_S, "step_s": -3600.0}]
    assert told["utc_ran_backwards"]
    assert any("was set back by 3600.0 s during the session or before it" in line for line in told["advice"])
    assert not rig.say("show", id="s001-r")["utc_ran_backwards"]
    rig.say("start", prism="r")
    assert rig.say("abort")["clock_steps"] == []


def test_a_clock_that_runs_ahead_between_sessions_is_none_that_was_set_back(rig: Rig) -> None:
    start(rig)
    rig.say("stop")
    ended = rig.clock.now()
    rig.clock.set(Stamp(ended.utc_ns + 3600 * NS_PER_S, ended.monotonic_ns, ended.boot_id))
    rig.say("start", prism="r")
    assert rig.say("stop")["clock_steps"] == []


def test_a_session_knows_how_the_computers_clock_was_at_its_start_and_end(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.clock_state = ClockState(False, source="kernel")
    start(rig, id="a")
    rig.live(2)
    rig.clock_state = ClockState(True, 2e-4, 5e-3, "chrony")
    summary = rig.say("stop")
    assert summary["clock"]["start"]["is_synchronized"] is False
    assert summary["clock"]["end"] == {
        "is_synchronized": True,
        "offset_s": 2e-4,
        "max_error_s": 5e-3,
        "source": "chrony",
        "error": "",
    }
    show_session(summary)
    said = capsys.readouterr().out
    assert "the computer's clock at its start: not synchronised with other clocks\n" in said
    assert "the computer's clock at its end: synchronised (chrony), 200 us ahead, off by at most 5 ms\n" in said


def test_a_session_on_another_clock_than_the_computers_notes_none(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    start(rig, id="a")
    summary = rig.say("abort")
    assert summary["clock"] == {"start": None, "end": None}
    show_session(summary)
    assert "computer's clock" not in capsys.readouterr().out


def test_a_steady_clock_is_not_flagged(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    summary = rig.say("stop")
    assert (summary["clock_steps"], summary["utc_ran_backwards"]) == ([], False)


def test_a_later_session_by_itself_is_timed_on_the_clock_of_all(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.say("stop")
    rig.live(30)
    rig.say("start", prism="r", operator="Ada", kind="check")
    rig.live(2)
    rig.say("stop")
    with Reader(rig.store.path) as reader:
        both, check = (
            parse_observations(sessions_csv(reader, SOURCE.rig, sessions), SOURCE.rig, "sessions")
            for sessions in (["s001-r", "s002-r"], ["s002-r"])
        )
    assert both.extra["time_s"][0] == 0.0
    assert check.extra["time_s"].tolist() == both.extra["time_s"][both.session == "s002-r"].tolist()
    assert check.extra["time_s"][0] > 30.0


@pytest.mark.parametrize("boot_id", ["manual", "next boot"])
def test_a_wall_clock_that_is_set_back_hides_no_jump_from_the_next_run(rig: Rig, boot_id: str) -> None:
    start(rig)
    now = rig.clock.now()
    rig.store.insert_records([DeviceEvent("theta1", now.shifted(NS_PER_S), EventKind.PRESET_JUMP, "from 22 to 33")])
    back_ns = 86_400 * NS_PER_S
    rig.clock.set(Stamp(now.utc_ns - back_ns, now.monotonic_ns + 2 * NS_PER_S, boot_id))
    if boot_id == "manual":
        late = rig.clock.now()
        rig.store.insert_records([DeviceEvent("theta3", late, EventKind.PRESET_JUMP, "from 22 to 33")])
    rig.keeper = rig.new_keeper()
    rig.live(2)
    summary = rig.say("stop")
    jumped = 2 if boot_id == "manual" else 1
    assert summary["observations"] == 0
    assert sum("jumped" in sentence for sentence in summary["advice"]) == jumped
