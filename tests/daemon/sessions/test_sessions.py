import itertools
import math
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.observations import parse_observations
from daemon.acquisition.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.acquisition.status.present import expected_of
from daemon.acquisition.status.snapshot import AcquisitionStatus
from daemon.cli.lines.state import show_session
from daemon.commands import CommandError
from daemon.config.config import Config
from daemon.config.sections import SessionsSection
from daemon.control.server import ControlServer
from daemon.host.time_service import ClockState
from daemon.rig_files import load_rig
from daemon.sessions.manager import SessionManager
from daemon.sessions.session_data import sessions_csv, setup_lines
from daemon.store.errors import NotInStoreError
from daemon.store.queries.observations import OF_CONTROL_POINT
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S, Stamp
from drivers.readings import DeviceEvent, EventKind, Record
from tests.daemon.support import sessions as session_support
from tests.daemon.support.sessions import SOURCE, STEP_S, Rig, closed_afterwards

rig = closed_afterwards(Rig)


def start(rig: Rig, **more: Any) -> None:
    rig.say("setup_new", id="S1", instrument="GTS-905A")
    rig.say("start", prism="r", operator="Ada", **more)


def test_every_standstill_becomes_a_pose(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    for rate in (5.0, -4.0):
        rig.live(1, theta1=rate)
        rig.live(2)
    summary = rig.say("stop")
    assert summary["poses"] == 3
    assert summary["state"] == "closed"
    assert summary["excluded"]["moving"] > 20


def test_observations_leave_as_the_contracts_csv_and_can_be_read_as_one(rig: Rig) -> None:
    start(rig, id="first")
    rig.live(0.5, theta4=0.2)
    rig.live(2)
    rig.say("stop")
    with Reader(rig.store.path) as reader:
        data = sessions_csv(reader, SOURCE.rig, ["first"])
    observations = parse_observations(data, SOURCE.rig, "stored")
    assert set(observations.prism) == {"r"}
    assert set(observations.setup) == {"S1"}
    assert set(observations.session) == {"first"}
    assert observations.joints["theta1"] == pytest.approx(22.5)
    assert observations.position_mm[0] == pytest.approx((3000.0, 8000.0, 1000.0), abs=1e-6)
    assert (observations.extra["dwell_s"] > 0).all()
    assert (observations.extra["theta1_rate"] == 0).all()


def test_a_standstill_is_one_pose_over_a_restart_of_the_daemon(rig: Rig) -> None:
    start(rig, id="first")
    rig.live(1, theta1=0.2)
    rig.live(3)
    rig.keeper = rig.new_keeper()
    rig.live(3)
    assert rig.say("show", id="first")["poses"] == 1
    rig.live(1, theta1=0.2)
    rig.live(1, theta1=-0.2)
    rig.live(3)  # back at the same place: another standstill
    rig.values["theta1"] += 0.1
    rig.keeper = rig.new_keeper()  # moved while the daemon was down
    rig.live(3)
    assert rig.say("stop")["poses"] == 3


def test_direction_and_dwell_are_empty_until_the_first_motion_after_a_start(rig: Rig) -> None:
    start(rig, id="first")
    rig.live(2)
    rig.live(1, theta1=-0.2)
    rig.live(2)
    rig.keeper = rig.new_keeper()  # as a daemon that was started again while the boom stands
    rig.live(2)
    rig.live(1, theta4=0.2)
    rig.live(2)
    rig.say("stop")
    with Reader(rig.store.path) as reader:
        observations = parse_observations(sessions_csv(reader, SOURCE.rig, ["first"]), SOURCE.rig, "stored")
        stored = list(reader.rows("SELECT theta1_dir FROM v_observations WHERE excluded IS NULL"))
    has_dwell = np.isfinite(observations.extra["dwell_s"])
    states = zip(has_dwell, observations.extra["theta1_dir"], observations.extra["theta4_dir"], strict=True)
    assert [
        state for state, _ in itertools.groupby(f"({dwell}, {theta1}, {theta4})" for dwell, theta1, theta4 in states)
    ] == [
        "(False, nan, nan)",
        "(True, -1.0, nan)",
        "(False, nan, nan)",  # the daemon started again
        "(True, nan, 1.0)",
    ]
    assert {row["theta1_dir"] for row in stored} == {None, -1.0}


def test_a_signal_without_a_device_stands_in_the_way_of_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "boom.toml"
    path.write_text(SOURCE.rig.with_signals("tilt_x_deg").text, encoding="utf-8")
    source = load_rig(str(path))
    monkeypatch.setattr(session_support, "SOURCE", source)
    assert expected_of(Config(rig=str(path)), source.rig) == expected_of(Config(rig="swdt82"), SOURCE.rig)
    rig = Rig(tmp_path / "rigcal.sqlite")
    start(rig, id="first")
    rig.live(2)
    assert rig.say("stop")["poses"] == 1
    with Reader(rig.store.path) as reader:
        data = sessions_csv(reader, source.rig, ["first"])
    rig.store.close()
    assert b"tilt" not in data
    assert "tilt_x_deg" not in parse_observations(data, source.rig, "stored").extra


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


def test_every_fix_is_its_session_s_by_when_it_was_measured_not_by_when_it_was_joined(rig: Rig) -> None:
    start(rig)
    begun = rig.clock.now().monotonic_ns
    rig.live(2)
    shot = rig.clock.now().monotonic_ns
    rig.shoot("cp1", (1500.0, 9000.0, 2000.0))
    rig.live(2)
    rig.say("stop")
    ended = rig.clock.now().monotonic_ns
    rig.live(2)
    observed = {row["monotonic_ns"] for row in rig.store.rows("SELECT monotonic_ns FROM observations")}
    measured = [row["monotonic_ns"] for row in rig.store.rows("SELECT monotonic_ns FROM fixes")]
    assert {t for t in measured if begun < t < shot} <= observed
    assert {t for t in measured if ended - NS_PER_S < t < ended} <= observed
    assert not {t for t in measured if t < begun or t > ended} & observed


def test_a_multi_joint_session_keeps_what_it_measures_while_moving(rig: Rig) -> None:
    start(rig, kind="multi_joint")
    rig.live(2)
    rig.live(1, theta1=5.0)
    assert "moving" not in rig.say("stop")["excluded"]


def test_an_aborted_session_is_kept_and_closed(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    assert rig.say("abort")["state"] == "aborted"
    assert rig.say("list")[0]["observations"] > 0


def test_without_a_session_nothing_is_observed(rig: Rig) -> None:
    rig.live(2)
    assert rig.store.rows("SELECT count(*) AS n FROM observations")[0]["n"] == 0


def test_a_second_session_is_refused_while_one_is_open(rig: Rig) -> None:
    start(rig)
    with pytest.raises(CommandError, match="session 's001-r' is open; stop or abort it first") as refused:
        rig.say("start", prism="b")
    assert "`rigcal session stop`, or `rigcal session abort`" in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"prism": "x"}, "no prism 'x'; it has w, b, r, s"),
        ({"prism": "r", "kind": "dance"}, "no kind 'dance'; kinds: single_joint"),
        ({"prism": "r", "setup": "S9"}, "no set-up 'S9'; known: S1"),
        ({"prism": "r", "id": "a b"}, "a session's id is 1 to 64 letters"),
        ({"prism": "r", "id": False}, "a session's id is 1 to 64 letters"),
        ({}, "no prism ''"),
    ],
)
def test_a_session_that_cannot_be_is_refused_in_a_sentence(rig: Rig, arguments: dict[str, str], reason: str) -> None:
    rig.say("setup_new", id="S1")
    with pytest.raises(CommandError, match=reason):
        rig.say("start", **arguments)
    assert rig.keeper.open_session() is None


def test_a_session_needs_a_setup(rig: Rig) -> None:
    with pytest.raises(CommandError, match="there is no station set-up; describe one with `rigcal setup new`"):
        rig.say("start", prism="r")


def test_commands_that_need_an_open_session_say_so(rig: Rig) -> None:
    for command in ("stop", "abort"):
        with pytest.raises(CommandError, match="no session is open"):
            rig.say(command)
    with pytest.raises(CommandError, match="no session is open"):
        rig.say("shoot", point="cp1")
    with pytest.raises(NotInStoreError, match="there is no session 'x'"):
        rig.say("show", id="x")


def test_an_open_session_survives_the_daemon(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.keeper = rig.new_keeper()
    rig.live(2)
    assert rig.say("stop")["id"] == "s001-r"


def test_an_open_session_ends_where_its_station_is_not_configured_any_more(rig: Rig) -> None:
    """What is known of the target of one station does not apply to another, nor to one of another name."""
    start(rig)
    rig.live(3)
    rig.target_mm = (9000.0, 8000.0, 1000.0)
    rig.live(1)
    rig.stations = ("station", "topcon")
    rig.keeper = rig.new_keeper()
    assert len(rig.keeper.prism_suspicions()) == 1, "another station that is added changes nothing"
    rig.stations = ("topcon",)
    rig.keeper = rig.new_keeper()
    assert rig.keeper.open_session() is None
    rig.live(2)
    (closed,) = rig.say("list")
    assert closed["note"] == (
        "closed by rigcal: station station was removed from the configuration or renamed while it was open"
    )
    rows = rig.store.rows("SELECT x_mm FROM observations WHERE excluded IS NULL")
    assert {round(row["x_mm"]) for row in rows} == {3000}


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


def test_the_operator_is_told_what_is_still_to_be_done(rig: Rig) -> None:
    rig.say("setup_new", id="S1")
    assert (
        "shoot a control point before the first pose (`rigcal session shoot NAME`)"
        in rig.say("start", prism="r", kind="check")["advice"][0]
    )
    rig.live(2)
    advice = rig.say("stop")["advice"]
    assert "control points not shot at the session's end" in advice[0]
    assert "a check session should have 3 to 5 poses; this one has 1" in advice[1]


def test_setups_are_described_once_and_checked(rig: Rig) -> None:
    rig.say("setup_new", id="S1", tilt_arcsec=3.0, ppm=12.0, prism_constants_mm={"r": -30.0})
    assert rig.say("setup_list")[0]["ppm"] == 12.0
    with pytest.raises(CommandError, match="set-up 'S1' exists already"):
        rig.say("setup_new", id="S1")
    with pytest.raises(CommandError, match="no prism 'q'"):
        rig.say("setup_new", id="S2", prism_constants_mm={"q": 1.0})


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


def test_after_an_encoder_jumped_nothing_of_the_session_is_used(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    before = rig.keeper.open_session()
    assert before is not None
    jump = DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "from 22 to 33")
    rig.store.insert_records([jump])
    rig.keeper.on_records([jump])
    rig.values["theta1"] += 11.0
    rig.live(2)
    rig.keeper = rig.new_keeper()  # a new start of the daemon knows of it too
    rig.live(2)
    summary = rig.say("stop")
    assert summary["observations"] <= before["observations"] + 12  # those that waited for their joints
    assert sum(n for reason, n in summary["excluded"].items() if reason.startswith("theta1 jumped")) > 60
    assert any("theta1 jumped" in sentence for sentence in summary["advice"])
    rig.say("start", prism="r")
    rig.live(2)
    assert rig.say("stop")["observations"] > 10


def test_a_jump_before_the_session_is_told_of_late_and_excludes_nothing(rig: Rig) -> None:
    jumped = rig.clock.now()
    rig.live(1)
    start(rig)
    rig.keeper.on_records([DeviceEvent("theta1", jumped, EventKind.PRESET_JUMP, "from 22 to 33")])
    rig.live(2)
    assert rig.say("stop")["observations"] > 10


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


def test_numbers_of_a_setup_must_be_numbers(rig: Rig) -> None:
    with pytest.raises(CommandError, match="tilt_arcsec must be a finite number"):
        rig.say("setup_new", id="S1", tilt_arcsec=math.nan)
    with pytest.raises(CommandError, match="give three coordinates in mm"):
        rig.say("setup_new", id="S1", control_points={"cp1": [1.0, 2.0]})
    for bad in ("abc", math.nan, [1], 1e300, True):
        with pytest.raises(CommandError, match="r must be a finite number"):
            rig.say("setup_new", id="S1", prism_constants_mm={"r": bad})
    with pytest.raises(CommandError, match="prism_constants_mm must be an object"):
        rig.say("setup_new", id="S1", prism_constants_mm=[])
    with pytest.raises(CommandError, match="note must be a text of at most 500"):
        rig.say("setup_new", id="S1", note="x" * 100_000)
    with pytest.raises(CommandError, match="a set-up's id is 1 to 64 letters"):
        rig.say("setup_new", id=10**30)
    assert rig.say("setup_list") == []


def test_automatic_names_avoid_those_that_are_taken(rig: Rig) -> None:
    start(rig, id="s002-r")
    rig.say("stop")
    assert rig.say("start", prism="r")["id"] == "s003-r"
