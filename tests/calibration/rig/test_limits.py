"""Angles recorded on any turn of their encoders mean the same to all that reads them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import DataError
from calibration.export.correction_grid import correction_grid
from calibration.model.inverse import inverse
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations, data_sha256, format_observations, parse_observations
from calibration.pipeline.calibrate import identify
from calibration.rig.description import Joint, Rig, shipped_rig
from calibration.rig.limits import beyond_limits, on_one_turn, turns_deg
from simulators.rig.truth import RigTruth
from tests.calibration.conftest import Session, rig_text
from tests.simulated.observations import simulate_observations

RIG = shipped_rig("ys100")


def limited(joint: str, low: float, high: float) -> Rig:
    joints = [j.model_copy(update={"limits": (low, high)}) if j.name == joint else j for j in RIG.joints]
    return RIG.model_copy(update={"joints": tuple(joints)})


def turned(rig: Rig, joint: str, *values: float) -> list[float]:
    joints = {j.name: np.full(len(values), sum(j.limits) / 2.0) for j in rig.joints} | {joint: np.array(values)}
    return [float(value) for value in on_one_turn(rig, joints)[joint].round(9)]


@pytest.mark.parametrize(
    ("low", "high", "read", "own"),
    [
        (-150.0, 150.0, [370.0, -370.0, 720.0, 350.0, 210.1, 149.0], [10.0, -10.0, 0.0, -10.0, -149.9, 149.0]),
        (-180.0, 180.0, [180.0, -180.0, 190.0, 360.0], [180.0, -180.0, -170.0, 0.0]),
        (-360.0, 360.0, [300.0, -300.0, 400.0], [300.0, -300.0, 40.0]),  # two turns are inside: as recorded
        (30.0, 150.0, [395.0, -325.0, 28.0], [35.0, 35.0, 28.0]),
    ],
)
def test_a_reading_is_brought_to_the_turn_of_its_limits(
    low: float, high: float, read: list[float], own: list[float]
) -> None:
    rig = limited("theta1", low, high)
    assert turned(rig, "theta1", *read) == own
    assert turned(rig, "theta1", *own) == own


def test_readings_that_no_turn_brings_inside_stay_together() -> None:
    """Of a reversed encoder: turned one by one they would fall into two heaps."""
    rig = limited("theta1", -175.0, -25.0)
    reversed_encoder = [30.0, 90.0, 100.0, 170.0]
    assert turned(rig, "theta1", *reversed_encoder) == reversed_encoder


def test_a_turn_counts_behind_a_gear_and_where_an_angle_drives_a_length() -> None:
    assert turns_deg(RIG).tolist() == [360.0] * 6
    assert turns_deg(shipped_rig("swdt82")).tolist() == [360.0] * 7 + [0.0] * 2

    def driven(row: int, **drive: dict[str, float]) -> Rig:
        rows = [r.model_copy(update={"drive": r.drive | drive}) if i == row else r for i, r in enumerate(RIG.rows)]
        return RIG.model_copy(update={"rows": tuple(rows)})

    assert turns_deg(driven(1, theta={"theta2": 1.0, "theta1": -0.5}))[:2].tolist() == [0.0, 360.0]
    assert turns_deg(driven(5, d={"theta6": 0.1}))[4:].tolist() == [360.0, 0.0]
    assert turned(driven(0, theta={"theta1": 0.5}), "theta1", 370.0) == [370.0]


def test_beyond_the_limits_is_beyond_a_share_of_the_range() -> None:
    joint = Joint(name="a", kind="revolute", limits=(0.0, 100.0), sigma=0.01)
    values = np.array([-6.0, -4.0, 50.0, 104.0, 106.0])
    assert beyond_limits(joint, values, 0.05).tolist() == [True, False, False, False, True]


# -- one turn for all --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def table() -> Observations:
    data = simulate_observations(RigTruth(RIG, 3), 80, 4, noise_mm=0.3).csv_text().encode()
    return parse_observations(data, RIG, "simulated.csv")


def on_another_turn(table: Observations) -> bytes:
    """The same fixes with angles of 0 .. 360 deg, and the first joint a turn further."""
    joints = {name: values % 360.0 for name, values in table.joints.items()}
    joints["theta1"] = joints["theta1"] + 360.0
    return format_observations(replace(table, joints=joints), RIG).encode()


@pytest.fixture(scope="module")
def model(table: Observations) -> CalibratedModel:
    """Of readings on another turn."""
    observations = parse_observations(on_another_turn(table), RIG, "turned.csv")
    return identify(RIG, rig_text("ys100"), observations, effects="none")


def test_a_file_reads_the_same_on_any_turn_and_after_it_was_written_out(table: Observations) -> None:
    read = parse_observations(on_another_turn(table), RIG, "turned.csv")
    for name, values in table.joints.items():
        np.testing.assert_allclose(read.joints[name], values, atol=1e-9)
    again = parse_observations(format_observations(read, RIG).encode(), RIG, "again.csv")
    assert data_sha256(again, RIG) == data_sha256(read, RIG)


@pytest.mark.slow
def test_a_model_of_readings_on_another_turn_has_commands_and_a_grid(
    model: CalibratedModel, table: Observations
) -> None:
    assert not [w for w in model.warnings if "beyond its limits" in w]
    rows = parse_observations(on_another_turn(table.select(np.arange(10))), RIG, "targets.csv")
    targets = replace(rows, position_mm=Predictor.of(model).predict(rows).position_mm)
    found = inverse(model, targets)
    assert found.reached.all()
    for joint in RIG.joints:
        low, high = model.coverage.ranges[joint.name]
        assert joint.limits[0] <= low < high <= joint.limits[1]
        np.testing.assert_allclose(found.observations.joints[joint.name], table.joints[joint.name][:10], atol=1e-3)
    nodes = correction_grid(model, ("tool",), 100, np.random.default_rng(0)).nodes
    assert {name: (ends[0], ends[-1]) for name, ends in nodes.items()} == dict(model.coverage.ranges)


@pytest.mark.slow
def test_a_grid_of_a_joint_that_was_trained_beyond_its_limits_alone_is_refused(session: Session) -> None:
    ranges = dict(session.model.coverage.ranges) | {"theta7": (10.0, 150.0)}
    model = replace(session.model, coverage=replace(session.model.coverage, ranges=ranges))
    with pytest.raises(DataError, match=r"theta7 was trained at 10.0 .. 150.0 deg, beyond its limits -175 .. -25"):
        correction_grid(model, ("r",), 600, np.random.default_rng(0))
