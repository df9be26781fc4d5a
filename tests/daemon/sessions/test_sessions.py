import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from calibration.observations import parse_observations
from daemon.acquisition.status.present import expected_of
from daemon.commands import CommandError
from daemon.config.config import Config
from daemon.rig_files import load_rig
from daemon.sessions.session_data import sessions_csv
from daemon.store.errors import NotInStoreError
from daemon.store.reader import Reader
from drivers.clock import NS_PER_S
from drivers.readings import DeviceEvent, EventKind
from tests.daemon.support import sessions as session_support
from tests.daemon.support.sessions import SOURCE, Rig, closed_afterwards, start

rig = closed_afterwards(Rig)


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


def test_the_operator_is_told_what_is_still_to_be_done(rig: Rig) -> None:
    rig.say("setup_new", id="S1")
    aim, shoot, *_ = rig.say("start", prism="r", kind="check")["advice"]
    assert "from now on, fixes count as prism r: aim the station at it" in aim
    assert "shoot a control point before the first pose (`rigcal session shoot NAME`)" in shoot
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


def test_after_an_encoder_jumped_nothing_of_the_session_is_used(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    before = rig.keeper.open_session()
    assert before is not None
    jump = DeviceEvent("theta1", rig.clock.now(), EventKind.PRESET_JUMP, "from 22 to 33")
    rig.store.insert_records([jump])
    rig.tell([jump])
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
    rig.tell([DeviceEvent("theta1", jumped, EventKind.PRESET_JUMP, "from 22 to 33")])
    rig.live(2)
    assert rig.say("stop")["observations"] > 10


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
