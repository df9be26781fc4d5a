"""A station that changes to a prism no further away than motion reaches: how the joints moved tells."""

from __future__ import annotations

import pytest

from daemon.acquisition.joiner import JoinedFix
from daemon.sessions.prisms.motion import LATE_S, TargetMotion
from drivers.clock import ManualClock
from drivers.readings import Fix, LockState, Status
from tests.daemon.sessions.prisms.test_prism_evidence import TrueRig, place_mm
from tests.daemon.support.sessions import SOURCE, STEP_S, closed_afterwards
from tests.daemon.support.store import table

RIG = SOURCE.rig
FIX_PERIOD_S = 0.35  # in which the guard takes any prism for able to move 1.85 m


class SlowStation(TrueRig):
    """A rig whose station gives a fix every seventh step."""

    steps_of_fix = round(FIX_PERIOD_S / STEP_S)

    def follow(self, target: str, rate_deg_s: float, fixes: int) -> None:
        """Slew the boom while the station measures where a true machine has a prism."""
        for _ in range(fixes * round(FIX_PERIOD_S / STEP_S)):
            self.values["theta1"] += rate_deg_s * STEP_S
            self.target_mm = place_mm(target, self.values)
            self.live(STEP_S)

    def swing(self, target: str, fixes: int) -> None:
        """Move the boom slowly in two joints while the station measures a prism."""
        for _ in range(fixes * round(FIX_PERIOD_S / STEP_S)):
            self.values["theta7"] += 4.0 * STEP_S
            self.values["theta3"] -= 4.0 * STEP_S
            self.target_mm = place_mm(target, self.values)
            self.live(STEP_S)


rig = closed_afterwards(SlowStation)


def assert_only_before(rig: SlowStation, session: str, until_ns: int) -> None:
    """Assert that the target is suspected, and that what was measured until then counts and nothing after it."""
    assert rig.keeper.prism_suspicions()
    rows = [row for row in table(rig.store.path, "observations") if row["session_id"] == session]
    assert not [row for row in rows if row["monotonic_ns"] > until_ns and row["excluded"] is None]
    assert [row for row in rows if row["monotonic_ns"] <= until_ns and row["excluded"] is None]


@pytest.mark.parametrize("kind", ["multi_joint", "static_poses"])
@pytest.mark.parametrize("rate_deg_s", [0.0, 6.0])
def test_a_change_to_a_near_prism_between_two_fixes_never_counts(
    rig: SlowStation, kind: str, rate_deg_s: float
) -> None:
    session = rig.say("start", prism="r", kind=kind)["id"]  # the set-up has seen nothing to compare with
    rig.values["theta1"] = 0.0
    rig.follow("r", 0.0, 6)
    rig.follow("r", rate_deg_s, 4)
    assert rig.keeper.prism_suspicions() == []
    changed_ns = rig.clock.now().monotonic_ns
    rig.follow("s", rate_deg_s, 4)
    rig.follow("s", 0.0, 6)
    (suspicion,) = rig.keeper.prism_suspicions()
    assert "from the motion of r computed from the joints" in suspicion.reason
    rows = [row for row in table(rig.store.path, "observations") if row["session_id"] == session]
    assert not [row for row in rows if row["monotonic_ns"] > changed_ns and row["excluded"] is None]
    assert [row for row in rows if row["monotonic_ns"] <= changed_ns and row["excluded"] is None]


def test_a_target_that_strays_little_by_little_was_another_one_since_the_station_was_silent(rig: SlowStation) -> None:
    session = rig.say("start", prism="w", kind="single_joint")["id"]
    rig.values["theta1"] = 40.0
    rig.follow("w", 0.0, 10)
    rig.clock.advance(8.0)  # the station is silent, and then follows r
    rig.values["theta1"] = 26.0
    silent_ns = rig.clock.now().monotonic_ns
    rig.follow("r", 0.0, 2)
    rig.swing("r", 20)
    assert_only_before(rig, session, silent_ns)


def test_a_target_that_strays_was_another_one_although_an_operator_had_just_confirmed_it(rig: SlowStation) -> None:
    session = rig.say("start", prism="w", kind="single_joint")["id"]
    rig.values["theta1"] = 40.0
    rig.follow("w", 0.0, 10)
    rig.say("confirm_prism", operator="Ada")
    confirmed_ns = rig.clock.now().monotonic_ns  # whoever looked through the telescope saw w; the next fix is of r
    rig.swing("r", 20)
    assert_only_before(rig, session, confirmed_ns)


def test_an_operator_s_word_lets_the_fixes_count_again(rig: SlowStation) -> None:
    rig.say("start", prism="r", kind="multi_joint")
    rig.follow("r", 0.0, 6)
    rig.follow("s", 0.0, 4)
    rig.say("confirm_prism", operator="Ada")
    rig.follow("s", 0.0, 4)
    rig.follow("s", 6.0, 4)
    assert rig.keeper.prism_suspicions() == []


def test_a_boom_that_moves_with_its_prism_is_not_suspected_however_fast(rig: SlowStation) -> None:
    rig.say("start", prism="r", kind="multi_joint")
    rig.values["theta1"] = -10.0
    for rate_deg_s in (0.0, 12.0, -12.0, 12.0):
        rig.follow("r", rate_deg_s, 5)
    assert rig.keeper.prism_suspicions() == []
    assert {row["excluded"] for row in table(rig.store.path, "observations")} == {None}


def jump_m(target: str, rate_deg_s: float, late_s: float = 0.0) -> float | None:
    """Of a fix of a target, read late, after one of r, while the boom slews."""
    clock, motion = ManualClock(), TargetMotion(RIG)
    values = {joint.name: sum(joint.limits) / 2 for joint in RIG.joints}
    found = None
    for number, (name, lag_s) in enumerate([("r", 0.0), (target, late_s)]):
        values["theta1"] = number * FIX_PERIOD_S * rate_deg_s
        seen_mm = place_mm(name, values | {"theta1": values["theta1"] - lag_s * rate_deg_s})
        columns = {joint.column: values[joint.name] for joint in RIG.joints} | {"theta1_rate": rate_deg_s}
        fix = Fix("station", clock.now(), clock.now(), Status.OK, LockState.LOCKED)
        joined = JoinedFix(fix, clock.now(), columns, None, None)
        found = motion.jump_m(joined, seen_mm, "r", ManualClock().now(), is_sure=True)
    return found


def test_a_fix_that_is_read_late_while_the_boom_moves_is_no_jump() -> None:
    for late_s in (0.0, 0.1, LATE_S):
        assert jump_m("r", 6.0, late_s) is None


@pytest.mark.parametrize("target", ["s", "b", "w"])
@pytest.mark.parametrize("rate_deg_s", [0.0, 3.0, -3.0, 12.0, -12.0])
def test_each_other_prism_is_a_jump_at_any_speed(target: str, rate_deg_s: float) -> None:
    assert jump_m(target, rate_deg_s) is not None
