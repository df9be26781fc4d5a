"""Groups and folds: nothing that knows of each other on both sides, and no fold that swallows the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.observations import Observations, parse_observations
from calibration.residual.folds import folds, group_labels, standstill_labels
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth
from tests.simulated.observations import simulate_observations

POSES = 120


@pytest.fixture(scope="module")
def sweeps() -> Observations:
    """One joint after the other swept through its range, all four prisms in each pose: most of them stand still."""
    rig = shipped_rig("swdt82")
    poses = {joint.name: np.full(POSES, np.mean(joint.limits)) for joint in rig.joints}
    for number, joint in enumerate(rig.joints[:6]):
        poses[joint.name][20 * number : 20 * number + 20] = np.linspace(*joint.limits, 20)
    data = simulate_observations(RigTruth(rig, 7), POSES, 0, poses=poses, noise_mm=3.0)
    return parse_observations(data.csv_text().encode(), rig, "sweeps.csv")


def test_single_joint_sweeps_make_even_folds(sweeps: Observations) -> None:
    labels = group_labels(sweeps)
    assert np.unique(labels, return_counts=True)[1].max() <= 0.1 * len(sweeps)
    sizes = np.bincount(folds(labels, 5, 0))
    assert sizes.max() <= 1.2 * sizes.min()


def test_a_standstill_is_in_one_group_and_its_group_is_one_of_its_own_cells(sweeps: Observations) -> None:
    labels, cells = group_labels(sweeps), sweeps.cells()
    for pose in np.unique(sweeps.pose):
        own = sweeps.pose == pose
        assert len(np.unique(labels[own])) == 1
        assert labels[own][0] in cells[own]


def test_poses_of_the_same_name_in_two_sessions_are_two_standstills(sweeps: Observations) -> None:
    half = np.where(np.arange(len(sweeps)) % 2 == 0, "monday", "tuesday")
    np.testing.assert_array_equal(group_labels(replace(sweeps, session=half)), half)


def test_without_standstills_groups_are_the_cells(sweeps: Observations) -> None:
    bare = replace(sweeps, pose=np.full(len(sweeps), "")).select(sweeps.prism == "r")
    np.testing.assert_array_equal(group_labels(bare), bare.cells())


def test_fixes_with_the_same_readings_are_a_standstill_without_a_name(sweeps: Observations) -> None:
    bare = replace(sweeps, pose=np.full(len(sweeps), ""))
    np.testing.assert_array_equal(group_labels(bare), group_labels(sweeps))


def test_along_a_path_groups_are_stretches_of_it_in_the_order_of_time(sweeps: Observations) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, len(sweeps))
    middle = {name: values.mean() for name, values in sweeps.joints.items()}
    joints = {name: middle[name] + 10.0 * np.sin((1 + k) * turn + k) for k, name in enumerate(sweeps.joints)}
    path = replace(sweeps, joints=joints, pose=np.full(len(sweeps), ""), extra={"time_s": turn})
    labels = group_labels(path)
    assert 15 <= len(np.unique(labels)) <= 60
    assert (labels[1:] == labels[:-1]).mean() > 0.85
    shuffled = np.random.default_rng(0).permutation(len(path))
    np.testing.assert_array_equal(group_labels(path.select(shuffled)), labels[shuffled])


def test_a_machine_of_a_few_millimetres_has_groups_as_a_large_one_has(sweeps: Observations) -> None:
    tiny = replace(sweeps, position_mm=sweeps.position_mm / 1e3)
    assert len(np.unique(group_labels(sweeps))) > 40
    assert len(np.unique(group_labels(tiny))) > 20
    assert len(np.unique(standstill_labels(replace(tiny, pose=np.full(len(tiny), ""))))) > 20


def test_fixes_of_a_standstill_are_one_draw_and_moving_fixes_one_a_cell(sweeps: Observations) -> None:
    labels = standstill_labels(sweeps)
    assert len(np.unique(labels)) == POSES < len(np.unique(sweeps.cells()))
    for pose in np.unique(sweeps.pose):
        assert len(np.unique(labels[sweeps.pose == pose])) == 1
    moving = standstill_labels(replace(sweeps, pose=np.full(len(sweeps), "")))
    assert len(np.unique(moving)) == len(np.unique(sweeps.cells()))
    half = np.where(np.arange(len(sweeps)) % 2 == 0, "monday", "tuesday")
    assert len(np.unique(standstill_labels(replace(sweeps, session=half)))) == 2 * POSES


def test_no_rows_have_no_groups(sweeps: Observations) -> None:
    none = sweeps.select(np.zeros(len(sweeps), dtype=bool))
    assert len(group_labels(none)) == len(standstill_labels(none)) == 0
