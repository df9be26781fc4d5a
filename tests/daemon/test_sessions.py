import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.observations import parse_observations
from daemon.config import SessionsSection
from daemon.control import CommandError
from daemon.joiner import ObservationJoiner, joint_inputs, signal_inputs
from daemon.rigs import load_rig
from daemon.session_data import sessions_csv, setup_lines
from daemon.sessions import SessionKeeper
from daemon.setups import SetupBook
from daemon.store.reader import Reader
from daemon.store.store import Store
from drivers.clock import NS_PER_S, ManualClock, Stamp
from drivers.readings import DeviceEvent, EventKind, Fix, LockState, Reading, Record, Status

SOURCE = load_rig("swdt82")
STEP_S = 0.05


class SharedClock(ManualClock):
    """A manual clock that one thread moves while another waits on it."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        deadline_ns = self.monotonic_ns() + round(seconds * NS_PER_S)
        while self.monotonic_ns() < deadline_ns and not event.wait(0.001):
            pass
        return event.is_set()


class Rig:
    """A machine and a station that can be stood still and moved, on a clock that only moves when told to."""

    def __init__(self, path: Path) -> None:
        self.clock = SharedClock()
        self.store = Store(path)
        self.store.begin_run(self.clock.now())
        self.store.declare_channels({j.name: j.unit for j in SOURCE.rig.joints}, {})
        self.values = {j.name: sum(j.limits) / 2 for j in SOURCE.rig.joints}
        self.target_mm = (3000.0, 8000.0, 1000.0)
        self.aimed: list[str] = []
        self.setups = SetupBook(SOURCE.rig, self.store, self.clock, SessionsSection().control_tolerance_mm)
        self.keeper = self.new_keeper()

    def new_keeper(self, aim: Callable[[str], None] | None = None) -> SessionKeeper:
        joiner = ObservationJoiner(joint_inputs(SOURCE.rig), signal_inputs(SOURCE.rig), settle_s=0.5)
        return SessionKeeper(
            SOURCE.rig,
            SOURCE.text,
            self.store,
            self.setups,
            joiner,
            SessionsSection(fixes_per_shot=3),
            self.clock,
            run_id=1,
            aim=aim,
        )

    def live(self, seconds: float, **rates: float) -> None:
        """Let time pass: every joint sampled and the station shooting at each step, as acquisition would tell it."""
        for _ in range(round(seconds / STEP_S)):
            self.clock.advance(STEP_S)
            for name, rate in rates.items():
                self.values[name] += rate * STEP_S
            records: list[Record] = [
                Reading(j.name, self.clock.now(), self.values[j.name], j.unit) for j in SOURCE.rig.joints
            ]
            records.append(self.fix())
            self.store.insert_records(records)
            self.keeper.on_records(records)

    def fix(self) -> Fix:
        east, north, up = (v / 1000 for v in self.target_mm)
        return Fix(
            "station",
            self.clock.now(),
            self.clock.now(),
            Status.OK,
            LockState.LOCKED,
            hz_angle_rad=math.atan2(east, north) % (2 * math.pi),
            zenith_angle_rad=math.atan2(math.hypot(east, north), up),
            slope_distance_m=math.sqrt(east**2 + north**2 + up**2),
        )

    def say(self, command: str, **arguments: Any) -> Any:
        owner, name = (self.setups, command[6:]) if command.startswith("setup_") else (self.keeper, command)
        return getattr(owner, f"{name}_command")(arguments)

    def shoot(self, point: str, place_mm: tuple[float, float, float]) -> Any:
        """Aim at a control point, shoot it, and aim back, with time passing meanwhile."""
        before, self.target_mm = self.target_mm, place_mm
        answer: list[Any] = []
        failure: list[CommandError] = []

        def ask() -> None:
            try:
                answer.append(self.say("shoot", point=point))
            except CommandError as error:
                failure.append(error)

        asking = threading.Thread(target=ask)
        asking.start()
        while asking.is_alive():
            self.live(STEP_S)
        asking.join()
        self.target_mm = before
        if failure:
            raise failure[0]
        return answer[0]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path / "rigcal.sqlite")
    yield made
    made.store.close()


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
    with pytest.raises(CommandError, match="session 's001-r' is open; stop or abort it first"):
        rig.say("start", prism="b")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"prism": "x"}, "no prism 'x'; it has w, b, r, s"),
        ({"prism": "r", "kind": "dance"}, "no kind 'dance'; kinds: single_joint"),
        ({"prism": "r", "setup": "S9"}, "no set-up 'S9'; known: S1"),
        ({"prism": "r", "id": "a b"}, "a session's id is 1 to 64 letters"),
        ({}, "no prism ''"),
    ],
)
def test_a_session_that_cannot_be_is_refused_in_a_sentence(rig: Rig, arguments: dict[str, str], reason: str) -> None:
    rig.say("setup_new", id="S1")
    with pytest.raises(CommandError, match=reason):
        rig.say("start", **arguments)
    assert rig.keeper.open_session() is None


def test_a_session_needs_a_setup(rig: Rig) -> None:
    with pytest.raises(CommandError, match="no usable station set-up; describe one with `rigcal setup new`"):
        rig.say("start", prism="r")


def test_commands_that_need_an_open_session_say_so(rig: Rig) -> None:
    for command in ("stop", "abort"):
        with pytest.raises(CommandError, match="no session is open"):
            rig.say(command)
    with pytest.raises(CommandError, match="no session is open"):
        rig.say("shoot", point="cp1")
    with pytest.raises(CommandError, match="there is no session 'x'"):
        rig.say("show", id="x")


def test_an_open_session_survives_the_daemon(rig: Rig) -> None:
    start(rig)
    rig.live(2)
    rig.keeper = rig.new_keeper()
    rig.live(2)
    assert rig.say("stop")["id"] == "s001-r"


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
    with pytest.raises(CommandError, match="no usable station set-up"):
        rig.say("start", prism="r")


def test_fixes_on_a_control_point_are_no_observations(rig: Rig) -> None:
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    rig.target_mm = (9000.0, 500.0, 2000.0)
    rig.live(2)
    summary = rig.say("stop")
    assert summary["observations"] == 0
    assert summary["excluded"]["a control point, not the prism"] > 10


def test_a_control_point_that_is_not_there_is_told(rig: Rig) -> None:
    start(rig)
    rig.keeper._settings = SessionsSection(fixes_per_shot=10_000, shot_timeout_s=1.0)
    with pytest.raises(CommandError, match="of 10000 good fixes within 1 s; is the station aimed"):
        rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    with pytest.raises(CommandError, match="'r' is a prism of the rig"):
        rig.say("shoot", point="r")


def test_where_something_can_aim_it_is_told_to(rig: Rig) -> None:
    rig.keeper = rig.new_keeper(aim=rig.aimed.append)
    start(rig)
    rig.shoot("cp1", (9000.0, 500.0, 2000.0))
    assert rig.aimed == ["r", "cp1", "r"]
    rig.new_keeper(aim=rig.aimed.append)
    assert rig.aimed == ["r", "cp1", "r", "r"], "a session that goes on after a restart is aimed for again"


def test_the_operator_is_told_what_is_still_to_be_done(rig: Rig) -> None:
    rig.say("setup_new", id="S1")
    assert "control points not shot at the session's start" in rig.say("start", prism="r", kind="check")["advice"][0]
    rig.live(2)
    advice = rig.say("stop")["advice"]
    assert "control points not shot at the session's end" in advice[0]
    assert "a check wants 3 to 5 poses; this one has 1" in advice[1]


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
