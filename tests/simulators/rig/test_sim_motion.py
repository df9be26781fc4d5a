from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.rig.description import Rig, shipped_rig
from simulators.rig.dataset import random_poses
from simulators.rig.motion import BoomMotion

RIG = shipped_rig("swdt82")


@given(st.integers(0, 10_000), st.floats(0.05, 1.0))
def test_a_move_respects_rates_and_limits_and_ends_where_it_was_told(seed: int, speed: float) -> None:
    drawn = random_poses(RIG, 3, np.random.default_rng(seed))
    motion = BoomMotion(RIG)
    end = 0.0
    for i in range(3):
        end = motion.move(0.0, {k: float(v[i]) for k, v in drawn.items()}, speed=speed)
    assert motion.values(end + 1e-6) == pytest.approx({k: float(v[2]) for k, v in drawn.items()})
    times = np.linspace(-1.0, end + 1.0, 200)
    for joint in RIG.joints:
        values, rates = np.array([motion.joint(joint.name, t) for t in times]).T
        assert values.min() >= joint.limits[0] - 1e-6
        assert values.max() <= joint.limits[1] + 1e-6
        assert np.abs(rates).max() <= speed * joint.max_rate * (1 + 1e-9)
        assert np.abs(np.diff(values)).max() <= speed * joint.max_rate * (times[1] - times[0]) * (1 + 1e-6)


def test_the_rate_is_the_slope_of_the_value(swdt82: Rig) -> None:
    motion = BoomMotion(swdt82, {"theta4": 0.0, "L2": 0.0})
    motion.move(0.0, {"theta4": 40.0, "L2": 10.0})
    for name in ("theta4", "L2"):
        for t in np.linspace(0.05, 8.5, 60):
            slope = (motion.joint(name, t + 1e-5)[0] - motion.joint(name, t - 1e-5)[0]) / 2e-5
            assert motion.joint(name, t)[1] == pytest.approx(slope, abs=1e-3)


def test_moves_queue_up_with_their_dwell_and_may_be_appended_while_running(swdt82: Rig) -> None:
    motion = BoomMotion(swdt82, {"theta4": 0.0})
    first = motion.move(0.0, {"theta4": 10.0}, dwell_s=3.0)
    second = motion.move(1.0, {"theta4": 0.0})
    assert not motion.moving(first + 1.5)
    assert motion.joint("theta4", first + 2.9)[0] == 10.0
    assert second == pytest.approx(first + 3.0 + first)
    assert motion.moving(first + 3.1)
    assert motion.joint("theta4", second)[0] == pytest.approx(0.0)


def test_directions_remember_the_last_motion_of_each_joint(swdt82: Rig) -> None:
    motion = BoomMotion(swdt82, {"theta4": 0.0})
    assert set(motion.directions(0.0).values()) == {0}
    end = motion.move(0.0, {"theta4": 10.0})
    back = motion.move(0.0, {"theta3": 50.0})
    assert motion.directions(end / 2)["theta4"] == 1
    assert motion.directions(back + 9)["theta4"] == 1
    assert motion.directions(back + 9)["theta3"] == -1
    assert motion.directions(end / 2)["theta3"] == 0


@given(st.floats(-15.0, 60.0), st.floats(-15.0, 60.0))
def test_a_joint_that_is_told_to_stay_where_it_is_does_not_turn_back(first: float, second: float) -> None:
    motion = BoomMotion(RIG, {"theta4": first})
    end = motion.move(0.0, {"theta4": second})
    was = motion.directions(end + 1)["theta4"]
    again = motion.move(end + 1, {"theta4": second, "theta3": 50.0})
    assert motion.joint("theta4", end + 1) == motion.joint("theta4", again) == (second, 0.0)
    assert motion.directions(again)["theta4"] == was


def test_the_past_can_be_asked_until_it_is_forgotten(swdt82: Rig) -> None:
    motion = BoomMotion(swdt82, {"theta4": 0.0})
    end = motion.move(0.0, {"theta4": 10.0})
    motion.move(end, {"theta4": 0.0})
    before = motion.joint("theta4", end / 2)
    motion.forget_before(end / 2)
    assert motion.joint("theta4", end / 2) == before
    motion.forget_before(end + 0.1)
    assert motion.joint("theta4", end + 0.1)[0] < 10.0


@pytest.mark.parametrize(
    ("pose", "speed", "message"),
    [
        ({"theta2": 1.0}, 0.5, "no joint 'theta2'; this rig has theta1"),
        ({"theta4": 61.0}, 0.5, r"theta4 = 61.0 is beyond its limits -15.0 .. 60.0"),
        ({"theta4": float("nan")}, 0.5, "beyond its limits"),
        ({"theta4": 1.0}, 0.0, "speed"),
        ({"theta4": 1.0}, 1.1, "speed"),
    ],
)
def test_an_impossible_move_is_refused(swdt82: Rig, pose: dict[str, float], speed: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BoomMotion(swdt82).move(0.0, pose, speed=speed)


def test_the_way_travelled_counts_there_and_back_and_the_rest_counts_from_the_last_arrival(swdt82: Rig) -> None:
    motion = BoomMotion(swdt82, {"theta4": 0.0})
    assert motion.travelled("theta4", 5.0) == 0.0
    assert motion.standing_s(5.0) == 5.0
    end = motion.move(10.0, {"theta4": 10.0}, dwell_s=4.0)
    assert motion.standing_s(9.0) == 9.0
    assert motion.standing_s((10.0 + end) / 2) == 0.0
    assert motion.travelled("theta4", (10.0 + end) / 2) == pytest.approx(5.0)
    assert motion.standing_s(end + 3.0) == pytest.approx(3.0)
    again = motion.move(end, {"theta4": 4.0})
    motion.move(again, {"theta4": 4.0})  # to where it is: no motion
    assert motion.travelled("theta4", again) == pytest.approx(16.0)
    assert motion.standing_s(again + 7.0) == pytest.approx(7.0)
    motion.forget_before(again + 7.0)
    assert motion.travelled("theta4", again + 7.0) == pytest.approx(16.0)
