"""Sessions whose station changes to another prism: what counts, what operators are told, what a restart remembers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from calibration.rig.description import shipped_rig
from daemon.cli.main import main
from daemon.commands import CommandError
from daemon.config.config import parse_config
from daemon.guide.times_away import times_away
from daemon.sessions.export.captured_logs import export_session
from daemon.sessions.export.session_file import SessionFile, read_session_file
from daemon.sessions.prisms.standstill_places import ELSEWHERE
from daemon.store.queries.observations import moving_observations
from daemon.store.reader import Reader
from drivers.clock import ManualClock
from drivers.logs.can_log import write_can_log
from drivers.logs.serial_log import SerialLogHeader, SerialLogWriter
from drivers.readings import CanCapture, EventKind, SerialCapture
from simulators.devices.stations.total_station import StationSettings
from simulators.faults import parse_faults
from simulators.rig.truth import RigTruth
from simulators.rig_simulator import RigSimulator, SimulatorSettings
from tests.daemon.support.sessions import STEP_S, Rig, closed_afterwards, disk_fails, start
from tests.daemon.support.store import table
from tests.simulated.captures import Step, generate
from tests.simulated.scripted_host import ScriptedHost

CONFIG = """rig = "swdt82"
state_directory = "."

[[can]]
channel = "can0"

[[station]]
profile = "passive"
serial.path = "/dev/rigcal-station"
"""
PRISM_MM = (3000.0, 8000.0, 1000.0)
ANOTHER_MM = (3000.0, 18000.0, 1000.0)
NEARER_MM = (6000.0, 8000.0, 1000.0)  # one fix a second does not show this jump of 3 m, but the joints do
CONTROL_MM = (9000.0, 500.0, 2000.0)


rig = closed_afterwards(Rig)


def used(rig: Rig) -> list[float]:
    """Where the observations lie that calibration may use: their y, mm."""
    return [round(row["y_mm"]) for row in table(rig.store.path, "observations") if row["excluded"] is None]


def reasons(rig: Rig) -> set[str]:
    return {row["excluded"] for row in table(rig.store.path, "observations")} - {None}


def events(rig: Rig, kind: EventKind) -> list[str]:
    return [row["text"] for row in table(rig.store.path, "device_events") if row["kind"] == kind]


@pytest.mark.long
def test_another_prism_s_fixes_never_become_observations_however_long_it_is_followed(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(40)
    assert set(used(rig)) == {8000}
    assert "perhaps another prism: the station's target jumped by 10.00 m" in reasons(rig)
    assert len(events(rig, EventKind.PRISM_JUMP)) == 1
    (suspicion,) = rig.keeper.open_session()["prism_suspicions"]  # type: ignore[index]
    assert suspicion["station"] == "station"
    assert suspicion["distance_m"] == pytest.approx(10.0)
    assert "confirm-prism" in suspicion["remedy"]
    assert [s.station for s in rig.keeper.prism_suspicions()] == ["station"]
    (told,) = [sentence for sentence in rig.say("stop")["advice"] if "perhaps another prism" in sentence]
    assert "confirm-prism" not in told, "a closed session takes no confirmation"
    assert "fixes before that stay in use; if the station was on another prism then as well, reject" in told
    assert rig.keeper.prism_suspicions() == []


def test_a_prism_that_an_operator_confirms_counts_from_then_on(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(5)
    before = len(used(rig))
    answer = rig.say("confirm_prism", operator="Ada")
    assert answer["text"] == "Ada confirms that the station is on prism r; its fixes are used from now on"
    assert [s["distance_m"] for s in answer["ended"]] == [pytest.approx(10.0)]
    (advice,) = answer["advice"]
    assert "if it was on another prism then, reject the session after its end: `rigcal session reject" in advice
    assert rig.keeper.prism_suspicions() == []
    rig.values["theta1"] += 5  # the next standstill: within one, the most fixes decide
    rig.live(5)
    assert set(used(rig)[before:]) == {18000}
    (row,) = table(rig.store.path, "prism_confirmations")
    assert (row["session_id"], row["operator"]) == (answer["session"], "Ada")
    assert events(rig, EventKind.PRISM_CONFIRMED) == [answer["text"]]


def test_a_guide_that_sends_the_station_to_a_control_point_hears_nothing_of_a_wrong_prism(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(5)
    assert rig.keeper.prism_suspicions()
    rig.keeper.look_away()
    assert rig.keeper.prism_suspicions() == []
    assert rig.keeper.open_session()["prism_suspicions"] == []  # type: ignore[index]
    assert [s for s in rig.say("stop")["advice"] if "perhaps another prism" in s], "but its fixes are not used"


def test_a_prism_is_confirmed_in_a_session_alone(rig: Rig) -> None:
    with pytest.raises(CommandError, match="no session is open"):
        rig.say("confirm_prism")
    start(rig)
    with pytest.raises(CommandError, match="operator must be a text"):
        rig.say("confirm_prism", operator="\x1b[2J")


def test_a_new_session_on_a_named_prism_is_a_confirmation(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.say("stop")
    rig.target_mm = (PRISM_MM[0], PRISM_MM[1] + 1500.0, PRISM_MM[2])  # as far as s is from r
    rig.live(1)
    rig.say("start", prism="s")
    rig.live(2)
    assert set(used(rig)) == {8000, 9500}
    assert rig.keeper.prism_suspicions() == []


def test_a_control_point_is_shot_in_a_session_without_a_suspicion(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.shoot("cp1", CONTROL_MM)
    rig.live(2)
    assert rig.keeper.prism_suspicions() == []
    assert events(rig, EventKind.PRISM_JUMP) == []
    assert set(used(rig)) == {8000}


def test_a_station_on_a_control_point_at_the_start_of_a_set_up_s_first_session_comes_to_the_prism_unsuspected(
    rig: Rig,
) -> None:
    """Where a restart would use the fixes, so does the daemon that goes on."""
    rig.target_mm = CONTROL_MM
    start(rig)
    rig.live(3)
    rig.shoot("cp1", CONTROL_MM)
    rig.target_mm = PRISM_MM
    rig.live(3)
    assert rig.keeper.prism_suspicions() == []
    assert events(rig, EventKind.PRISM_JUMP) == []
    assert set(used(rig)) == {8000}
    assert len(used(rig)) > 40
    rig.target_mm = ANOTHER_MM
    rig.live(1)
    assert len(rig.keeper.prism_suspicions()) == 1, "and the prism is watched from then on"


def test_fixes_of_a_control_point_before_its_first_shot_do_not_outnumber_those_of_the_prism(rig: Rig) -> None:
    near_mm = (PRISM_MM[0], PRISM_MM[1] + 330.0, PRISM_MM[2])  # too near to be a jump
    start(rig)
    rig.live(2)
    rig.target_mm = near_mm
    rig.live(4)
    assert set(used(rig)) == {8330}
    rig.shoot("cp1", near_mm)
    rig.target_mm = PRISM_MM
    rig.live(0.5)
    assert set(used(rig)) == {8000}
    assert not [why for why in reasons(rig) if why.startswith(ELSEWHERE)]


def test_a_suspicion_of_fixes_on_a_control_point_is_not_revived_by_a_restart(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = CONTROL_MM  # by hand, before the command
    rig.live(1)
    rig.shoot("cp1", CONTROL_MM)
    rig.keeper = rig.new_keeper()
    assert rig.keeper.prism_suspicions() == []
    rig.target_mm = PRISM_MM
    rig.live(1)
    assert rig.keeper.prism_suspicions() == []


def test_a_station_that_comes_back_from_a_control_point_to_another_prism_is_suspected(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.shoot("cp1", CONTROL_MM)
    rig.target_mm = ANOTHER_MM
    rig.live(5)
    assert len(rig.keeper.prism_suspicions()) == 1
    assert set(used(rig)) == {8000}
    rig.target_mm = PRISM_MM
    rig.live(2)
    assert rig.keeper.prism_suspicions() == []


def test_a_control_point_that_is_shot_while_another_prism_is_suspected_is_usable(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = CONTROL_MM  # by hand, before the command
    rig.live(1)
    assert len(rig.keeper.prism_suspicions()) == 1
    assert rig.shoot("cp1", CONTROL_MM)["y_mm"] == pytest.approx(500.0)
    rig.target_mm = PRISM_MM
    rig.live(2)
    assert rig.keeper.prism_suspicions() == []
    assert set(used(rig)) == {8000}


def test_a_restart_of_the_daemon_ends_no_suspicion(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.target_mm = ANOTHER_MM
    rig.live(5)
    rig.keeper = rig.new_keeper()
    assert [round(s.distance_m, 3) for s in rig.keeper.prism_suspicions()] == [10.0]
    rig.live(5)
    assert set(used(rig)) == {8000}
    rig.say("confirm_prism")
    rig.keeper = rig.new_keeper()
    assert rig.keeper.prism_suspicions() == []


@pytest.mark.parametrize("steps_of_fix", [1, 20])
def test_a_restart_ends_no_suspicion_that_the_first_fixes_after_it_do_not_show(rig: Rig, steps_of_fix: int) -> None:
    rig.steps_of_fix = steps_of_fix
    start(rig)
    rig.live(5)
    rig.target_mm = NEARER_MM
    rig.live(4)
    (before,) = rig.keeper.prism_suspicions()
    for _ in range(2):
        rig.keeper = rig.new_keeper()
        (after,) = rig.keeper.prism_suspicions()
        assert (after.reason, round(after.distance_m, 2)) == (before.reason, 3.0)
        rig.live(5)
    assert {round(row["x_mm"]) for row in table(rig.store.path, "observations") if row["excluded"] is None} == {3000}
    rig.say("confirm_prism")
    rig.keeper = rig.new_keeper()
    assert rig.keeper.prism_suspicions() == []


def test_a_suspicion_that_began_while_the_boom_moved_outlasts_a_restart_before_it_stands(rig: Rig) -> None:
    rig.steps_of_fix = 20
    start(rig)
    rig.live(5)
    rig.target_mm = NEARER_MM
    rig.live(3, theta1=0.5)
    assert len(rig.keeper.prism_suspicions()) == 1
    rig.keeper = rig.new_keeper()
    assert len(rig.keeper.prism_suspicions()) == 1
    rig.live(5)
    assert {round(row["x_mm"]) for row in table(rig.store.path, "observations") if row["excluded"] is None} == {3000}


@pytest.mark.parametrize("moving_s", [1.2, 3.0])
def test_a_jump_that_only_a_usual_interval_shows_outlasts_a_restart_before_the_boom_stands(
    rig: Rig, moving_s: float
) -> None:
    rig.steps_of_fix = 10  # 0.5 s: after a restart a second is assumed, in which a prism may move 5 m
    start(rig)
    rig.live(6)
    rig.target_mm = NEARER_MM
    rig.live(moving_s, theta1=1.0)
    (before,) = rig.keeper.prism_suspicions()
    rig.keeper = rig.new_keeper()
    assert [one.reason for one in rig.keeper.prism_suspicions()] == [before.reason]
    rig.live(6)
    assert {round(row["x_mm"]) for row in table(rig.store.path, "observations") if row["excluded"] is None} == {3000}


def test_moving_fixes_of_a_suspected_prism_give_no_latency(rig: Rig) -> None:
    start(rig)
    rig.live(5)
    rig.target_mm = ANOTHER_MM
    rig.live(1)
    rig.live(5, theta1=1.0)
    rig.target_mm = PRISM_MM
    rig.live(2)
    rig.live(5, theta1=1.0)
    with rig.store.reader() as reader:
        moving = moving_observations(reader, ["s001-r"])
    assert {round(row["y_mm"]) for row in moving} == {8000}


def test_a_restart_forgets_not_that_the_newest_fix_lies_elsewhere(rig: Rig) -> None:
    start(rig)
    rig.live(3)
    x, y, z = rig.target_mm
    rig.target_mm = (x + 200.0, y, z)
    rig.live(STEP_S)
    rig.steps_of_fix = 10**6  # a station that is aimed by hand: no fix for a while
    rig.live(2)
    why = rig.keeper.not_counting()
    assert why is not None
    assert why.startswith(ELSEWHERE)
    rig.keeper = rig.new_keeper()
    rig.live(20)
    assert rig.keeper.not_counting() == why


def test_another_prism_that_was_found_while_the_daemon_was_away_is_suspected(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.clock.advance(3600)
    rig.target_mm = ANOTHER_MM
    rig.keeper = rig.new_keeper()
    rig.live(5)
    assert len(rig.keeper.prism_suspicions()) == 1
    assert set(used(rig)) == {8000}


def test_where_something_can_aim_a_station_that_is_suspected_is_aimed_again(rig: Rig) -> None:
    def aim(target: str) -> None:
        rig.aimed.append(target)
        rig.target_mm = PRISM_MM

    rig.keeper = rig.new_keeper(aim)
    start(rig)
    rig.live(2)
    rig.keeper.aim_again()
    assert rig.aimed == ["r"]
    rig.target_mm = ANOTHER_MM  # taken for the turn that the start told it to make
    rig.live(1)
    rig.target_mm = (3000.0, 28000.0, 1000.0)
    rig.live(1)
    assert len(rig.keeper.prism_suspicions()) == 1
    with disk_fails():
        rig.keeper.aim_again()  # which cannot be written down, and ends no daemon
    assert rig.aimed == ["r", "r"]
    rig.target_mm = (3000.0, 28000.0, 1000.0)
    rig.live(1)
    rig.keeper.aim_again()
    assert rig.aimed == ["r", "r", "r"]
    rig.values["theta1"] += 5
    before = len(used(rig))
    rig.live(2)
    assert set(used(rig)[before:]) == {8000}
    assert [row["turning"] for row in table(rig.store.path, "prism_confirmations")] == [1, 1]


def test_what_operators_confirmed_is_exported_with_the_session(rig: Rig, tmp_path: Path) -> None:
    start(rig, id="s1")
    rig.live(2)
    rig.say("confirm_prism")
    confirmed_ns = rig.clock.now().utc_ns
    rig.live(2)
    rig.say("stop")
    rig.store.end_run(rig.clock.now())
    config = parse_config(CONFIG, tmp_path / "rigcal.toml")
    export_session(config, "s1", tmp_path / "out", "log", times_away)
    assert read_session_file(tmp_path / "out" / "s1.json").prism_confirmed_utc_ns == (confirmed_ns,)


# ---- a simulated rig -------------------------------------------------------------------------------------------------

JUMP_S, BACK_S, END_S = 12, 60, 70


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of a rig that stands, moves once and stands; prism r is followed, then b for 48 s, then r again."""
    folder = tmp_path_factory.mktemp("wrong-prism")
    station = StationSettings(profile="topcon_gts8", push_interval_s=0.5)
    settings = SimulatorSettings(bus_master="machine", sync_period_s=0.2, signal_period_s=0.5, station=station)
    faults = parse_faults(f"prism_jump@{JUMP_S}:to=b,prism_jump@{BACK_S}:to=r")
    simulator = RigSimulator(RigTruth(shipped_rig("swdt82"), 7), 7, settings, faults=faults)
    plan = [Step(0.0, aim="r"), Step(20.0, pose={"theta4": 24.0}), Step(40.0, pose={"theta4": 22.0})]
    captures = generate(simulator, ScriptedHost(), END_S, ManualClock(), plan=plan).captures
    write_can_log(folder / "boom.log", [c for c in captures if isinstance(c, CanCapture)])
    with (folder / "station.serial").open("w", encoding="utf-8", newline="\n") as stream:
        writer = SerialLogWriter(stream, SerialLogHeader("station", station.baud, "passive"))
        for capture in captures:
            if isinstance(capture, SerialCapture):
                writer.write(capture)
    (folder / "rigcal.toml").write_text(CONFIG, encoding="utf-8")
    return folder


def replayed(folder: Path, store: Path, *options: object) -> list[dict[str, Any]]:
    """The observations that the logs give, with the second of each."""
    logs = [folder / "boom.log", folder / "station.serial"]
    arguments = ["replay", *logs, "--config", folder / "rigcal.toml", "--store", store, *options]
    result = CliRunner().invoke(main, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    with Reader(store) as reader:
        return [
            {**row, "second": (row["utc_ns"] - ManualClock().now().utc_ns) / 1e9}
            for row in reader.rows("SELECT * FROM observations ORDER BY id")
        ]


def test_in_a_simulated_rig_prism_b_never_becomes_prism_r(recorded: Path, tmp_path: Path) -> None:
    rows = replayed(recorded, tmp_path / "s.sqlite", "--prism", "r", "--kind", "multi_joint")
    followed_b = [row for row in rows if JUMP_S + 1 < row["second"] < BACK_S]
    assert len(followed_b) > 80
    counting = [row["second"] for row in rows if row["excluded"] is None]
    assert min(counting) < JUMP_S
    assert max(counting) > BACK_S + 5
    assert [s for s in counting if JUMP_S + 1 < s < BACK_S] == []


def test_a_replay_uses_no_fix_from_the_times_when_a_guide_knew_that_the_station_was_on_no_prism(
    recorded: Path, tmp_path: Path
) -> None:
    begin_ns, second_ns = ManualClock().now().utc_ns, 10**9
    on_b, on_r = (JUMP_S + 1) * second_ns, (BACK_S + 1) * second_ns
    told = SessionFile(
        prism="r",
        kind="static_poses",
        since_utc_ns=begin_ns + on_b,  # the station holds b at two poses, and only then is aimed at r
        until_utc_ns=begin_ns + END_S * second_ns,
        control_points={},
        prism_confirmed_utc_ns=(begin_ns + on_r,),
        away_utc_ns=(
            (begin_ns + on_b, begin_ns + on_r),
            (begin_ns + (END_S - 2) * second_ns, begin_ns + END_S * 10**9),
        ),
    )
    (tmp_path / "s.json").write_text(told.model_dump_json(), encoding="utf-8")
    rows = replayed(recorded, tmp_path / "s.sqlite", "--session", tmp_path / "s.json")
    assert {row["excluded"] for row in rows} == {None}
    assert BACK_S + 1 <= rows[0]["second"] < BACK_S + 2
    assert END_S - 3 < rows[-1]["second"] <= END_S - 2


def test_a_replay_honours_what_the_operator_confirmed(recorded: Path, tmp_path: Path) -> None:
    begin_ns = ManualClock().now().utc_ns
    told = SessionFile(
        prism="r",
        kind="multi_joint",
        since_utc_ns=begin_ns,
        until_utc_ns=begin_ns + END_S * 10**9,
        control_points={},
        prism_confirmed_utc_ns=(begin_ns + 30 * 10**9,),
    )
    (tmp_path / "s.json").write_text(told.model_dump_json(), encoding="utf-8")
    rows = replayed(recorded, tmp_path / "s.sqlite", "--session", tmp_path / "s.json")
    moving = [row["second"] for row in rows if row["excluded"] is None and row["moving"]]
    assert [s for s in moving if JUMP_S + 1 < s < 30] == []  # on b, not confirmed
    assert [s for s in moving if 30 < s < BACK_S] != []  # on b, which the operator said to be r
    back = [row["excluded"] for row in rows if row["second"] > BACK_S + 1]
    assert all(reason is not None and "perhaps another prism" in reason for reason in back)
