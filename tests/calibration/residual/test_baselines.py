"""The incumbents: a table of corrections per cell of reach and direction, and the first paper's network as printed."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.observations import Floats
from calibration.residual.baselines import THETA, CorrectionTable, PaperRbfn, best_theta
from calibration.residual.features import Features
from tests.calibration.conftest import rms

AXES = ("x", "y", "z")


def at(prism_mm: Floats) -> Features:
    none = np.empty((len(prism_mm), 3, 0))
    return Features(
        ("q1_deg", *(f"prism_{axis}_mm" for axis in AXES)),
        np.hstack([np.zeros((len(prism_mm), 1)), prism_mm]),
        np.empty((len(prism_mm), 0)),
        none,
        none,
    )


def polar(reach_mm: Floats, direction_deg: Floats) -> Floats:
    angle = np.radians(direction_deg)
    return np.column_stack([reach_mm * np.cos(angle), reach_mm * np.sin(angle), np.full(len(reach_mm), 700.0)])


def boom(n: int, seed: int) -> tuple[Features, Floats]:
    """Two joints and four frames of an arm, and an error that depends on the joints."""
    joints = np.random.default_rng(seed).uniform(-60.0, 60.0, (n, 2))
    turned = np.radians(np.cumsum(joints, axis=1))
    origins = [np.zeros((n, 3))]
    for angle in turned.T:
        origins.append(origins[-1] + 3000.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]))
    places = np.hstack([*origins[1:], origins[-1] + [0.0, 0.0, 300.0]])
    names = ("q1_deg", "q2_deg", *(f"{p}_{a}_mm" for p in ("frame1", "frame2", "prism") for a in AXES))
    none = np.empty((n, 3, 0))
    error = np.column_stack([np.sin(turned[:, 1]), np.cos(turned[:, 0]) - 0.8, turned[:, 0] * turned[:, 1]])
    return Features(names, np.hstack([joints, places]), np.empty((n, 0)), none, none), error


def test_a_cell_has_the_mean_error_of_its_fixes_and_an_empty_one_none() -> None:
    where = polar(np.array([9500.0, 9600.0, 10000.0, 2500.0]), np.array([5.0, 6.0, 100.0, 5.0]))
    error = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0], [9.0, 9.0, 9.0], [-4.0, 0.0, 0.0]])
    table = CorrectionTable.fit(at(where), error)
    asked = polar(np.array([9550.0, 9999.0, 2100.0, 9550.0, 5000.0]), np.array([1.0, 104.0, 14.0, 16.0, 5.0]))
    np.testing.assert_allclose(
        table.predict(at(asked)), [[2.0, 2.0, 2.0], [9.0, 9.0, 9.0], [-4.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3]
    )


def test_beyond_the_longest_reach_nothing_is_stored() -> None:
    where = polar(np.array([1000.0, 5000.0]), np.array([0.0, 0.0]))
    table = CorrectionTable.fit(at(where), np.ones((2, 3)))
    assert (table.predict(at(where)) == 1.0).all()
    assert (table.predict(at(polar(np.array([5001.0, 50000.0]), np.zeros(2)))) == 0.0).all()


def test_directions_meet_behind_the_base() -> None:
    reach = np.full(2, 4000.0)
    table = CorrectionTable.fit(at(polar(reach, np.array([179.0, -179.0]))), np.array([[1.0] * 3, [2.0] * 3]))
    behind = table.predict(at(polar(np.full(3, 4000.0), np.array([180.0, -180.0, 181.0]))))
    assert set(behind[:, 0].tolist()) <= {1.0, 2.0}
    assert behind[2, 0] == 2.0


def test_a_table_helps_where_the_error_varies_slowly_over_reach_and_direction() -> None:
    rng = np.random.default_rng(3)

    def drawn(n: int) -> tuple[Features, Floats]:
        reach, direction = rng.uniform(3000.0, 12000.0, n), rng.uniform(-60.0, 60.0, n)
        return at(polar(reach, direction)), np.column_stack([reach / 1000.0, direction / 10.0, 0.0 * reach])

    training, held_out = drawn(2000), drawn(500)
    left = held_out[1] - CorrectionTable.fit(*training).predict(held_out[0])
    assert rms(left) < 0.15 * rms(held_out[1])


def test_the_paper_s_network_sees_joints_and_frames_and_has_a_hundred_centres() -> None:
    seen, error = boom(300, 0)
    network = PaperRbfn.fit(seen, error)
    assert network.theta == THETA == 0.05
    assert network.centres.shape == (100, 2 + 6)
    assert network.centres.min() >= 0.0
    assert network.centres.max() <= 1.0
    unseen, truth = boom(300, 1)
    assert rms(truth - network.predict(unseen)) < 0.2 * rms(truth)


def test_as_a_standard_deviation_the_printed_width_would_say_nothing_of_other_poses() -> None:
    """Why it is read as a factor on distances."""
    seen, error = boom(300, 0)
    unseen, truth = boom(300, 1)
    narrow = PaperRbfn.fit(seen, error, theta=1.0 / (np.sqrt(2.0) * 0.05) * 4.0)  # 36 inputs for these 8
    assert rms(truth - narrow.predict(unseen)) > 0.9 * rms(truth)


def test_the_best_width_is_the_one_with_the_least_error_on_groups_held_out() -> None:
    seen, error = boom(400, 2)
    noisy = error + np.random.default_rng(4).normal(0, 0.1, error.shape)
    groups = np.arange(400).astype(np.str_)
    unseen, truth = boom(400, 5)

    def held_out(theta: float) -> float:
        return rms(truth - PaperRbfn.fit(seen, noisy, theta=theta).predict(unseen))

    best = best_theta(seen, noisy, groups)
    assert held_out(best) < 1.2 * min(map(held_out, (0.05, 0.4, 3.2)))


@pytest.mark.parametrize("count", [1, 2, 30])
def test_few_rows_and_constant_inputs_are_no_obstacle(count: int) -> None:
    seen, error = boom(count, 6)
    assert np.isfinite(PaperRbfn.fit(seen, error).predict(boom(20, 7)[0])).all()
    assert np.isfinite(CorrectionTable.fit(seen, error).predict(boom(20, 7)[0])).all()
