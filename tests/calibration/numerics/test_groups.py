"""Poses along a path are held out in stretches of it; independent poses are not taken for a path."""

from __future__ import annotations

import numpy as np

from calibration.numerics.groups import path_stretches, same_readings
from calibration.observations import Floats

JOINTS, ROWS = 6, 400
ONE_TRACK = np.zeros(ROWS, dtype=np.intp)


def path(turns: float) -> Floats:
    """(400, 6) deg: every joint swings at a pace of its own, `turns` times over at the slowest."""
    at = np.linspace(0.0, 2.0 * np.pi * turns, ROWS)
    return np.column_stack([30.0 * np.sin((1 + k % 3) * at + k) for k in range(JOINTS)])


def test_a_path_is_split_into_stretches_of_neighbours() -> None:
    labels = path_stretches(path(0.9), ONE_TRACK)
    assert labels is not None
    assert 10 <= len(np.unique(labels)) <= 60
    assert (np.diff(labels) != 0).sum() < 2 * len(np.unique(labels))


def test_a_path_driven_again_is_in_the_stretches_of_the_first_time() -> None:
    once = path(1.0)[::2]
    labels = path_stretches(np.concatenate([once, once]), ONE_TRACK)
    assert labels is not None
    np.testing.assert_array_equal(labels[: ROWS // 2], labels[ROWS // 2 :])


def test_prisms_seen_one_after_the_other_do_not_hide_a_path() -> None:
    labels = path_stretches(np.repeat(path(0.9), 3, axis=0), np.zeros(3 * ROWS, dtype=np.intp))
    assert labels is not None
    np.testing.assert_array_equal(labels[::3], labels[1::3])


def test_independent_poses_follow_no_path() -> None:
    rng = np.random.default_rng(3)
    assert path_stretches(rng.uniform(-60.0, 60.0, (ROWS, JOINTS)), ONE_TRACK) is None
    cubes = np.repeat(rng.uniform(-60.0, 60.0, (8, JOINTS)), ROWS // 8, axis=0)
    assert path_stretches(cubes + rng.normal(0.0, 5.0, cubes.shape), ONE_TRACK) is None


def test_a_coarse_grid_measured_line_by_line_is_no_path() -> None:
    slow, quick = np.meshgrid(np.linspace(-90.0, 90.0, 40), np.linspace(-40.0, 60.0, 10), indexing="ij")
    assert path_stretches(np.column_stack([slow.ravel(), quick.ravel()]), ONE_TRACK) is None


def test_joints_that_stand_or_few_rows_make_no_path() -> None:
    assert path_stretches(np.zeros((ROWS, JOINTS)), ONE_TRACK) is None
    assert path_stretches(path(1.0)[:20], ONE_TRACK[:20]) is None


def test_rows_with_the_same_readings_of_one_track_are_one_standstill() -> None:
    readings = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 2.5], [1.0, 2.0]])
    found = same_readings(readings, np.array([0, 0, 0, 1]))
    assert found[0] == found[1]
    assert len(np.unique(found)) == 3
