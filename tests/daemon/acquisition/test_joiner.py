"""A joined fix carries the joints at its own instant, or says why it does not."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.rig.description import shipped_rig
from daemon.acquisition.joiner import JoinedFix, ObservationJoiner, joint_inputs, signal_inputs
from daemon.acquisition.tracks import JointInput, SignalInput
from drivers.readings import (
    DecodeFailure,
    DeviceEvent,
    EventKind,
    Gap,
    GapReason,
    Reading,
    Record,
    Status,
)
from tests.daemon.support.store import at, fix, reading

THETA = JointInput("theta1", "deg", 0.03)
LENGTH = JointInput("L2", "mm", 1.2)


def moving(seconds: float) -> float:
    """A joint that swings by 10 deg."""
    return 10.0 * math.sin(seconds)


def samples(
    until_s: float, value: object = moving, *, start_s: float = 0.0, period_s: float = 0.02, name: str = "theta1"
) -> list[Record]:
    """Readings at a steady rate, a little off the full second."""
    count = round((until_s - start_s) / period_s)
    times = [start_s + 0.003 + i * period_s for i in range(count)]
    unit = "mm" if name.startswith("L") else "deg"
    return [reading(name, t, value(t) if callable(value) else float(value), unit) for t in times]  # type: ignore[arg-type] # a number where not callable


def join(records: Sequence[Record], *joints: JointInput, **options: object) -> list[JoinedFix]:
    joiner = ObservationJoiner(joints or (THETA,), **options)  # type: ignore[arg-type] # options of any type
    return joiner.feed([*records, reading("elsewhere", 1000.0, 0.0)])


def preset(seconds: float, channel: str = "theta1") -> DeviceEvent:
    return DeviceEvent(channel, at(seconds), EventKind.PRESET_JUMP, "from 3 to 90")


# ---- interpolation ---------------------------------------------------------------------------------------------------


def test_joints_are_taken_at_the_instant_of_the_fix() -> None:
    (joined,) = join([*samples(2.0), *samples(2.0, lambda t: 100 * t, name="L2"), fix(1.0)], THETA, LENGTH)
    assert joined.fix == fix(1.0)
    assert joined.stamp == at(1.0)
    assert joined.refused == ""
    assert joined.values["theta1_deg"] == pytest.approx(moving(1.0), abs=1e-3)
    assert joined.values["L2_mm"] == pytest.approx(100.0, abs=1e-9)


def test_the_link_delay_of_the_station_is_taken_off() -> None:
    (joined,) = join([*samples(2.0, lambda t: t), fix(1.0)], link_delay_s={"ts1": 0.25})
    assert joined.stamp == at(0.75)
    assert joined.values["theta1_deg"] == pytest.approx(0.75)


def test_a_fix_at_the_very_instant_of_a_sample_takes_that_sample() -> None:
    records: list[Record] = [reading("theta1", t / 10, t) for t in range(10)]
    (joined,) = join([*records, fix(0.5)])
    assert joined.values["theta1_deg"] == 5.0


@pytest.mark.parametrize(
    ("before", "after", "instant", "expected"),
    [
        (179.0, -179.0, 0.5, (180.0, -180.0)),
        (179.0, -179.0, 0.25, (179.5,)),
        (179.0, -179.0, 0.75, (-179.5,)),
        (-179.0, 179.0, 0.75, (179.5,)),
        (359.0, 1.0, 0.25, (359.5,)),
        (719.0, 1.0, 0.75, (0.5,)),
    ],
)
def test_an_angle_goes_the_short_way_round(
    before: float, after: float, instant: float, expected: tuple[float, ...]
) -> None:
    joint = JointInput("theta1", "deg", 0.03, max_gap_s=1.0)
    (joined,) = join([reading("theta1", 0, before), reading("theta1", 1, after), fix(instant)], joint, deadline_s=0.0)
    assert any(joined.values["theta1_deg"] == pytest.approx(value) for value in expected)


def test_a_length_does_not_wrap() -> None:
    joint = JointInput("L2", "mm", 1.0, max_gap_s=1.0)
    records: list[Record] = [reading("L2", 0, 0.0, "mm"), reading("L2", 1, 1000.0, "mm"), fix(0.75)]
    (joined,) = join(records, joint, deadline_s=0.0)
    assert joined.values["L2_mm"] == pytest.approx(750.0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 400), st.floats(0.0, 0.3))
def test_neither_order_nor_batches_of_records_change_what_is_joined(seed: int, batch: int, delay_s: float) -> None:
    fixes = [fix(t / 20) for t in range(5, 50)]
    records: list[Record] = [*samples(3.0), *samples(3.0, lambda t: 50 * t, period_s=0.013, name="L2"), *fixes]
    expected = join(records, THETA, LENGTH, link_delay_s={"ts1": delay_s})
    assert [j.fix for j in expected] == fixes
    in_time: list[Record] = sorted(
        records, key=lambda r: r.stamp.monotonic_ns if isinstance(r, Reading) else fixes_ns(r)
    )
    joiner = ObservationJoiner([THETA, LENGTH], link_delay_s={"ts1": delay_s})
    joined: list[JoinedFix] = []
    for start in range(0, len(in_time), batch):
        part = in_time[start : start + batch]
        random.Random(seed).shuffle(part)
        joined += joiner.feed(part)
    assert joined == expected


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 400), st.floats(-20.0, 20.0))
def test_one_link_may_be_read_long_after_another(batch: int, later_s: float) -> None:
    fixes = [fix(t / 4) for t in range(1, 40)]
    sampled = [*samples(11.0), *samples(11.0, lambda t: 50 * t, period_s=0.1, name="L2")]
    expected = join([*sampled, *fixes], THETA, LENGTH)
    as_read = [(fixes_ns(r) + later_s * 1e9, r) for r in fixes] + [(fixes_ns(r), r) for r in sampled]
    in_time = [record for _, record in sorted(as_read, key=lambda item: item[0])]
    joiner = ObservationJoiner([THETA, LENGTH])
    joined: list[JoinedFix] = []
    for start in range(0, len(in_time), batch):
        joined += joiner.feed(in_time[start : start + batch])
    assert joined == expected


def fixes_ns(record: Record) -> int:
    assert not isinstance(record, Gap)
    return record.stamp.monotonic_ns


# ---- refusals --------------------------------------------------------------------------------------------------------


def test_a_fix_waits_for_joints_that_come_later() -> None:
    joiner = ObservationJoiner([THETA])
    assert joiner.feed([fix(1.0), *samples(1.09)]) == []
    (joined,) = joiner.feed(samples(2.0, start_s=1.1))
    assert joined.refused == ""


def test_a_fix_of_a_silent_joint_is_refused_after_the_deadline() -> None:
    joiner = ObservationJoiner([THETA, LENGTH], deadline_s=2.0)
    assert joiner.feed([*samples(4.0, 5.0), *samples(0.9, 5.0, name="L2"), fix(1.0)])[0].refused == (
        "L2: no sample after the fix"
    )
    assert joiner.refusals == {"L2: no sample after the fix": 1}


def test_where_all_joints_are_silent_a_fix_waits_as_long_as_samples_are_kept() -> None:
    joiner = ObservationJoiner([THETA], deadline_s=2.0)
    assert joiner.feed([fix(1.0), fix(31.4, Status.NOT_AVAILABLE)]) == []
    (joined,) = joiner.feed([fix(31.6, Status.NOT_AVAILABLE)])
    assert joined.refused == "theta1: no sample before the fix"
    assert joined.values == {}
    assert (joined.dwell_s, joined.standstill) == (None, None)


def test_what_is_known_of_the_other_joints_is_told_all_the_same() -> None:
    (joined,) = join([*samples(4.0, 5.0), fix(1.0)], THETA, LENGTH)
    assert joined.refused == "L2: no sample before the fix"
    assert joined.values["theta1_deg"] == 5.0


def test_samples_too_far_apart_are_not_bridged() -> None:
    (joined,) = join([*samples(0.9), *samples(3.0, start_s=1.2), fix(1.0)])
    assert joined.refused == "theta1: its samples around the fix are more than 0.25 s apart"


@pytest.mark.parametrize("status", [Status.NOT_AVAILABLE, Status.DEVICE_ALARM, Status.OUT_OF_RANGE])
def test_a_bad_reading_beside_the_fix_is_not_bridged(status: Status) -> None:
    bad = reading("theta1", 1.001, None, status=status)
    (joined,) = join([*samples(3.0), bad, fix(1.0)])
    assert joined.refused == f"theta1: its reading at the fix is {status.value}"


def test_a_reading_that_is_no_number_is_a_bad_one() -> None:
    (joined,) = join([*samples(3.0), reading("theta1", 0.999, math.nan), fix(1.0)])
    assert joined.refused == "theta1: its reading at the fix is malformed"


def test_a_preset_jump_is_not_interpolated_over() -> None:
    def preset_at_1(t: float) -> float:
        return 3.0 if t < 1 else 90.0

    records: list[Record] = [*samples(3.0, preset_at_1), preset(1.003), fix(0.95), fix(1.0), fix(1.05)]
    before, across, after = join(records)
    assert across.refused == "theta1: its encoder was preset at the fix"
    assert (before.values["theta1_deg"], after.values["theta1_deg"]) == (3.0, 90.0)
    assert before.values["theta1_rate"] == after.values["theta1_rate"] == pytest.approx(0.0)


def test_a_preset_jump_ends_the_standstill_and_what_is_known_of_motion_before_it() -> None:
    def rises_and_is_preset_at_4(t: float) -> float:
        return min(t, 1.0) if t < 4 else 90.0

    presets = [preset(4.003), preset(4.003), preset(4.0, "other")]
    before, after = join([*samples(7.0, rises_and_is_preset_at_4), *presets, fix(3.0), fix(6.0)])
    assert (before.values["theta1_dir"], before.standstill) == (1.0, 1)
    assert before.dwell_s == pytest.approx(2.0, abs=0.1)
    assert "theta1_dir" not in after.values
    assert (after.dwell_s, after.standstill) == (None, 2)


def test_fixes_that_are_not_ok_are_passed_over() -> None:
    joiner = ObservationJoiner([THETA])
    assert joiner.feed([*samples(3.0), fix(1.0, Status.NOT_AVAILABLE)]) == []
    assert joiner.refusals == {}


def test_another_boot_ends_what_was_pending_and_begins_anew() -> None:
    joiner = ObservationJoiner([THETA], [SignalInput("valve", "valve_mA", 5.0)])
    late = Reading("theta1", at(0.5, "boot-b"), 1.0, "deg")
    (joined,) = joiner.feed([*samples(1.0, 5.0), reading("valve", 0.5, 3.0, "mA"), fix(0.99), late])
    assert joined.refused == "theta1: no sample after the fix"
    assert joined.values == {"valve_mA": 3.0}
    records = [Reading("theta1", at(t / 50, "boot-b"), 1.0, "deg") for t in range(150)]
    standing = fix(2.0)
    moved = type(standing)("ts1", at(2.0, "boot-b"), at(2.0, "boot-b"), Status.OK, standing.lock)
    (joined,) = joiner.feed([*records, moved])
    assert joined.refused == ""
    assert "valve_mA" not in joined.values
    assert joined.standstill == 2


def test_records_of_other_kinds_and_channels_do_not_matter() -> None:
    others: list[Record] = [
        Gap("theta1", GapReason.SILENT, at(0.5)),
        DecodeFailure("theta1", at(0.6), "short", b""),
        DeviceEvent("theta1", at(0.7), EventKind.WARNING, ""),
        reading("elsewhere", 0.8, 1.0),
    ]
    assert join([*samples(2.0), *others, fix(1.0)]) == join([*samples(2.0), fix(1.0)])


def test_an_older_sample_that_comes_late_is_left_out() -> None:
    joiner = ObservationJoiner([THETA], [SignalInput("valve", "valve_mA", 5.0)])
    joiner.feed([*samples(1.5, 5.0), reading("valve", 0.5, 3.0, "mA")])
    (joined,) = joiner.feed([reading("theta1", 0.9, 99.0), reading("valve", 0.2, 9.0, "mA"), fix(0.9)])
    assert joined.values["theta1_deg"] == 5.0
    assert joined.values["valve_mA"] == 3.0


# ---- motion ----------------------------------------------------------------------------------------------------------


def plan(t: float) -> float:
    """Stands till 2 s, rises to 5 s, stands till 8 s, falls to 9 s, stands."""
    return 10.0 + 4 * (min(max(t, 2.0), 5.0) - 2.0) - 6 * (min(max(t, 8.0), 9.0) - 8.0)


def with_noise(value: float, generator: random.Random) -> float:
    return value + generator.gauss(0.0, 0.005)


@pytest.fixture(scope="module")
def journey() -> dict[float, JoinedFix]:
    """Fixes of a boom that follows `plan`, with an encoder's noise, by their time."""
    generator = random.Random(7)
    records = samples(14.0, lambda t: with_noise(plan(t), generator))
    fixes = [fix(t / 10) for t in range(3, 135)]
    return {(j.stamp.monotonic_ns - at(0).monotonic_ns) / 1e9: j for j in join([*records, *fixes], THETA, settle_s=1.0)}


def test_the_direction_is_that_of_the_last_motion(journey: dict[float, JoinedFix]) -> None:
    direction = {t: j.values.get("theta1_dir") for t, j in journey.items()}
    assert {direction[t] for t in direction if t < 2.0} == {None}, "it has not been seen to move yet"
    assert {direction[t] for t in direction if 2.1 < t < 8.0} == {1.0}
    assert {direction[t] for t in direction if t > 8.1} == {-1.0}


def test_the_rate_is_the_slope_around_the_fix(journey: dict[float, JoinedFix]) -> None:
    assert journey[3.5].values["theta1_rate"] == pytest.approx(4.0, abs=0.1)
    assert journey[8.5].values["theta1_rate"] == pytest.approx(-6.0, abs=0.1)
    assert journey[7.0].values["theta1_rate"] == pytest.approx(0.0, abs=0.1)


def test_a_single_sample_has_no_rate() -> None:
    (joined,) = join([reading("theta1", 1.0, 5.0), fix(1.0)], deadline_s=0.0) or join(
        [reading("theta1", 1.0, 5.0), reading("theta1", 9.0, 5.0), fix(1.0)]
    )
    assert joined.values == {"theta1_deg": 5.0}


def test_dwell_counts_from_the_last_motion_of_any_joint(journey: dict[float, JoinedFix]) -> None:
    assert journey[3.5].dwell_s == pytest.approx(0.0, abs=0.02)
    assert journey[7.5].dwell_s == pytest.approx(2.5, abs=0.3)
    assert journey[13.0].dwell_s == pytest.approx(4.0, abs=0.3)
    assert journey[13.0].columns()["dwell_s"] == journey[13.0].dwell_s


def test_each_standstill_has_a_number_and_motion_has_none(journey: dict[float, JoinedFix]) -> None:
    number = {t: j.standstill for t, j in journey.items()}
    assert {number[t] for t in number if t < 0.9} == {None}
    assert {number[t] for t in number if 1.2 < t < 1.5} == {1}
    assert {number[t] for t in number if 1.6 < t < 5.9} == {None}, "what comes just before motion is no standstill"
    assert {number[t] for t in number if 6.4 < t < 7.5} == {2}
    assert {number[t] for t in number if 7.6 < t < 9.9} == {None}
    assert {number[t] for t in number if t > 10.4} == {3}


@pytest.mark.parametrize("later_s", [0.3, 1.9, 2.4])
def test_a_motion_that_is_read_late_is_a_motion_at_its_own_instant(later_s: float) -> None:
    def turns(*times_s: tuple[float, float]) -> Callable[[float], float]:
        return lambda t: sum(5.0 * min(max(t - start_s, 0.0), end_s - start_s) for start_s, end_s in times_s)

    def joined(late_s: float) -> list[JoinedFix]:
        arriving = [(fixes_ns(r), r) for r in samples(32.0, turns((22.2, 22.6), (27.0, 27.5)))]
        late = samples(32.0, turns((19.0, 20.5), (25.4, 25.6)), name="theta8")
        arriving += [(fixes_ns(r) + (late_s * 1e9 if fixes_ns(r) > 15e9 else 0.0), r) for r in late]
        arriving += [(fixes_ns(r), r) for r in (fix(19.001 + n / 10) for n in range(60))]
        joiner = ObservationJoiner((THETA, JointInput("theta8", "deg", 0.03)))
        return [one for _, r in sorted(arriving, key=lambda item: item[0]) for one in joiner.feed([r])]

    def stood(fixes: Sequence[JoinedFix]) -> list[tuple[float | None, int | None]]:
        return [(one.dwell_s, one.standstill) for one in fixes]

    in_time = joined(0.0)
    assert {one.standstill for one in in_time} == {None, 2, 3}
    assert stood(joined(later_s)) == stood(in_time)


def test_noise_alone_is_no_motion() -> None:
    generator = random.Random(3)
    records = samples(120.0, lambda _: with_noise(10.0, generator))
    (joined,) = join([*records, fix(119.0)])
    assert (joined.standstill, joined.dwell_s) == (1, None)
    assert "theta1_dir" not in joined.values


def test_a_long_standstill_is_remembered_by_a_late_fix() -> None:
    def moves_at_once_and_at_100(t: float) -> float:
        return 5.0 if t < 0.5 else 10.0 if t < 100 else 20.0

    (joined,) = join([*samples(101.0, moves_at_once_and_at_100), fix(99.0)])
    assert joined.dwell_s == pytest.approx(98.5, abs=0.01)
    assert joined.standstill == 1


# ---- motion that was not seen ----------------------------------------------------------------------------------------


def rises_in_the_first_second(t: float) -> float:
    return min(t, 1.0)


def test_a_boom_that_stands_since_the_start_is_a_standstill_of_unknown_dwell_and_direction() -> None:
    early, late = join([*samples(6.0, 5.0), fix(0.5), fix(5.0)])
    assert (early.standstill, late.standstill) == (None, 1)
    assert (early.dwell_s, late.dwell_s) == (None, None)
    assert "dwell_s" not in late.columns()
    assert "theta1_dir" not in late.values


def test_the_motion_of_one_joint_tells_the_dwell_but_no_direction_of_another() -> None:
    (joined,) = join([*samples(5.0, rises_in_the_first_second), *samples(5.0, 7.0, name="L2"), fix(4.0)], THETA, LENGTH)
    assert joined.dwell_s == pytest.approx(3.0, abs=0.1)
    assert joined.values["theta1_dir"] == 1.0
    assert "L2_dir" not in joined.values


@pytest.mark.parametrize(("after_deg", "standstill"), [(1.0, 1), (1.02, 1), (-4.0, 2), (6.0, 2)])
def test_after_an_outage_direction_and_dwell_are_unknown_wherever_the_joint_is(
    after_deg: float, standstill: int
) -> None:
    """It may have gone up and come back down, even where it is as before; only elsewhere it is another standstill."""
    cut = [*samples(4.0, rises_in_the_first_second), *samples(70.0, after_deg, start_s=64.0)]
    before, after = join([*cut, fix(3.0), fix(68.0)])
    assert (before.values["theta1_dir"], before.standstill) == (1.0, 1)
    assert "theta1_dir" not in after.values
    assert (after.dwell_s, after.standstill) == (None, standstill)


def test_motion_after_an_outage_is_known_again() -> None:
    def falls_at_66(t: float) -> float:
        return 1.0 - 3.0 * min(max(t - 66.0, 0.0), 1.0)

    (joined,) = join([*samples(4.0, rises_in_the_first_second), *samples(71.0, falls_at_66, start_s=64.0), fix(70.0)])
    assert joined.values["theta1_dir"] == -1.0
    assert joined.dwell_s == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize(("bad_s", "is_known"), [(0.9, True), (3.0, False)])
def test_bad_readings_hide_a_motion_if_they_last_long_enough(bad_s: float, is_known: bool) -> None:
    bad = [reading("theta1", 2.01 + n / 20, None, status=Status.DEVICE_ALARM) for n in range(round(bad_s * 20))]
    good = [*samples(2.0, rises_in_the_first_second), *samples(9.0, 1.0, start_s=2.0 + bad_s)]
    (joined,) = join([*good, *bad, fix(8.0)])
    assert ("theta1_dir" in joined.values) == is_known
    assert (joined.dwell_s is not None) == is_known
    assert joined.standstill == 1


def test_a_joint_that_was_silent_may_have_moved_after_the_others() -> None:
    """The dwell since the last motion that was seen would be wrong, though every other joint was seen all the time."""

    def moves_at_30(t: float) -> float:
        return 100.0 if t < 30 else 200.0

    of_theta = [*samples(4.0, rises_in_the_first_second), *samples(70.0, 1.0, start_s=64.0)]
    (joined,) = join([*of_theta, *samples(70.0, moves_at_30, name="L2"), fix(68.0)], THETA, LENGTH)
    assert joined.values["L2_dir"] == 1.0
    assert joined.dwell_s is None


def test_the_state_tells_how_long_the_boom_is_seen_to_stand_though_its_dwell_is_unknown() -> None:
    joiner = ObservationJoiner([THETA])
    joiner.feed(samples(5.0, 7.0))
    state = joiner.latest()
    assert not isinstance(state, str)
    assert state.dwell_s is None
    assert state.stands_s == pytest.approx(5.0, abs=0.1)


# ---- signals ---------------------------------------------------------------------------------------------------------


def test_signals_are_the_latest_before_the_fix() -> None:
    records = [*samples(3.0), *(reading("valve", t / 2, float(t), "mA") for t in range(6)), fix(1.25)]
    (joined,) = join(records, THETA, signals=[SignalInput("valve", "valve_mA", 5.0)])
    assert joined.values["valve_mA"] == 2.0


@pytest.mark.parametrize(
    "signal",
    [
        reading("valve", 0.1, 3.0, "mA"),  # too old
        reading("valve", 1.5, 3.0, "mA"),  # after the fix
        reading("valve", 0.9, None, "mA", Status.NOT_AVAILABLE),
    ],
)
def test_a_signal_that_is_old_late_or_bad_is_not_there(signal: Reading) -> None:
    (joined,) = join([*samples(3.0), signal, fix(1.0)], THETA, signals=[SignalInput("valve", "valve_mA", 0.5)])
    assert "valve_mA" not in joined.values


# ---- rigs ------------------------------------------------------------------------------------------------------------


def test_a_rig_says_what_its_fixes_need() -> None:
    rig = shipped_rig("swdt82")
    joints = {joint.name: joint for joint in joint_inputs(rig)}
    assert tuple(joints) == rig.joint_names
    assert joints["theta1"] == JointInput("theta1", "deg", pytest.approx(0.03), 0.25)  # type: ignore[arg-type] # approximate
    assert joints["L2"].motion_threshold == pytest.approx(1.2)
    signals = signal_inputs(rig)
    assert {s.name for s in signals} == {c.name for c in rig.channels} - set(rig.joint_names)
    assert all(s.column == next(c.column for c in rig.channels if c.name == s.name) for s in signals)


def test_a_signal_is_joined_until_its_channel_counts_as_silent() -> None:
    rig = shipped_rig("swdt82")
    of_name = {channel.name: channel for channel in rig.channels}
    slow, quick = of_name["temperature"].model_copy(update={"timeout_s": 30.0}), of_name["boom_pressure"]
    inputs = signal_inputs(rig.model_copy(update={"channels": (slow, quick)}))
    sent: list[Record] = [reading(slow.name, float(t), 20.0, slow.unit) for t in range(0, 31, 10)]
    sent += [reading(quick.name, t / 10, 100.0, quick.unit) for t in range(100)]
    fixes = [fix(t / 4) for t in range(4, 160)]
    joined = join([*samples(45.0, 5.0), *sent, *fixes], THETA, signals=inputs)
    assert all(slow.column in j.values for j in joined), "a value every 10 s is not old"
    last_s = max(j.stamp.since(at(0.0)) / 1e9 for j in joined if quick.column in j.values)
    assert last_s == pytest.approx(9.9 + 1.0, abs=0.2), "it was last read at 9.9 s"


def test_a_thousand_samples_a_second_are_no_burden() -> None:
    """Ten joints at 100 Hz and a 20 Hz station: the work grows with the time, not with its square."""
    joints = [JointInput(f"q{i}", "deg", 0.03) for i in range(10)]

    def worked_s(seconds: float) -> float:
        records: list[Record] = [r for j in joints for r in samples(seconds, moving, period_s=0.01, name=j.name)]
        fixes = round(20 * seconds)
        records += [fix(t / 20) for t in range(fixes)]
        joiner = ObservationJoiner(joints)
        started = time.process_time()
        joined = joiner.feed(records)
        worked = time.process_time() - started
        assert sum(not j.refused for j in joined) >= fixes - 15
        return worked

    assert worked_s(40.0) < 10 * worked_s(10.0), "four times the samples: four times the work, not sixteen"


# ---- doubtful times --------------------------------------------------------------------------------------------------


def late(seconds: float, channel: str = "theta1", unit: str = "deg") -> Reading:
    return Reading(channel, at(seconds).doubted(), None, unit, Status.TIME_DOUBTFUL, 4711)


def test_a_fix_of_doubtful_time_is_not_joined() -> None:
    doubtful = replace(fix(1.0), stamp=at(1.0).doubted(), status=Status.TIME_DOUBTFUL)
    assert join([*samples(2.0), doubtful]) == []


def test_a_reading_of_doubtful_time_tells_nothing_of_any_instant() -> None:
    records = [r for r in samples(3.0) if not 0.99 < r.stamp.since(at(0.0)) / 1e9 < 1.5]  # type: ignore[union-attr] # readings
    (joined,) = join([*records, *(late(1.0 + n / 50) for n in range(25)), fix(1.2)])
    assert "samples around the fix are more than 0.25 s apart" in joined.refused


def test_readings_of_doubtful_time_do_not_keep_a_standing_joint_from_being_joined() -> None:
    records = [r for r in samples(3.0, 5.0) if not 0.99 < r.stamp.since(at(0.0)) / 1e9 < 1.5]  # type: ignore[union-attr] # readings
    (joined,) = join([*records, late(1.25), fix(1.2)])
    assert joined.refused == ""
    assert joined.values["theta1_deg"] == pytest.approx(5.0)


def test_a_signal_of_doubtful_time_leaves_the_value_before_it() -> None:
    joiner = ObservationJoiner((THETA,), (SignalInput("pump", "pump_bar", 5.0),))
    records: list[Record] = [reading("pump", 0.5, 120.0, "bar"), late(0.9, "pump", "bar")]
    (joined,) = joiner.feed([*samples(2.0), *records, fix(1.0)])
    assert joined.values["pump_bar"] == 120.0
