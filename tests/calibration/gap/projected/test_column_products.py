"""Products of columns without their zeros, and columns that no fit changes: the same numbers with less work."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from calibration.gap.candidates import CandidateEffect, candidate_at, candidate_effects, variants_at
from calibration.gap.projected.column_products import ProjectedProducts
from calibration.gap.projected.projection import Projection
from calibration.gap.regimes import _Columns
from calibration.gap.screening import SCALES, Screen
from calibration.observations import parse_observations
from calibration.rig.description import shipped_rig
from simulators.rig.truth import RigTruth
from tests.calibration.gap.test_effect_forms import fitted
from tests.simulated.observations import simulate_observations

RIG = shipped_rig("swdt82")
NAMES = [
    ("joint_error_map", "theta4"),
    ("encoder_harmonic", "theta7"),
    ("joint_error_map", "theta7"),
    ("joint_compliance", "theta4"),
    ("base_settlement", "base"),
]


@pytest.fixture(scope="module")
def shared() -> Projection:
    """A fit to fixes of all prisms in every pose, which share the noise of its readings; not in the order of poses."""
    table = simulate_observations(RigTruth(RIG, 3), 60, 3, noise_mm=3.0)
    rows = parse_observations(table.csv_text().encode(), RIG, "simulated.csv")
    projection = fitted(RIG, rows.select(np.random.default_rng(1).permutation(len(rows))))
    assert np.bincount(np.unique(projection.samples.standstill, return_inverse=True)[1]).max() == len(RIG.prisms)
    return projection


def candidates(over: Projection) -> list[CandidateEffect]:
    return [candidate_at(over.context, over, *name, variants_at(over.context, *name)) for name in NAMES]


def test_products_are_those_of_the_projected_columns(shared: Projection) -> None:
    blocks = [additions for own in candidates(shared) for additions in (own.additions[0], own.additions[-1])]
    rare = [(block.column != 0.0).mean() <= 0.25 and block.shift_mm is None for block in blocks]
    assert any(rare)
    assert not all(rare)
    products = ProjectedProducts(shared, blocks)
    columns = [shared.columns(shared.moved_mm(block)) for block in blocks]
    for a, b in itertools.product(range(len(blocks)), repeat=2):
        expected = columns[a].T @ columns[b]
        np.testing.assert_allclose(products.product(a, b), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    for number, own in enumerate(columns):
        expected = own.T @ shared.residual
        np.testing.assert_allclose(products.along(number), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_every_form_and_scale_is_weighed_as_by_itself(shared: Projection) -> None:
    """Forms that differ in their prior alone share their axes, and each has the evidence of its own prior."""
    own = candidates(shared)[0]
    screen = Screen(shared, [own])
    scored = screen.score()[0]
    assert len(set(own.first_equal)) < len(own.options)
    each = [
        screen.log_bayes_factor([(0, option)], [scale])
        + own.log_odds[option]
        + np.log({1 / 3: 0.2, 1.0: 0.5, 3.0: 0.25, 10.0: 0.05}[scale])
        for option, scale in itertools.product(range(len(own.options)), SCALES)
    ]
    assert scored.log_bayes_factor == pytest.approx(np.logaddexp.reduce(each), abs=1e-6)


def test_a_part_of_the_data_is_weighed_as_its_rows_are(shared: Projection) -> None:
    some = np.arange(0, len(shared.samples), 2)
    above = np.random.default_rng(2).random(len(some)) < 0.4
    every = candidates(shared)
    found = _Columns(shared, every, some).evidence(1, above.astype(np.intp))
    rows = (3 * some[:, None] + np.arange(3)).ravel()
    inside = np.repeat(above, 3)
    kinematics, target = shared.kinematics[rows], shared.target[rows]
    covariance = np.eye(len(rows)) + kinematics @ kinematics.T
    precision = np.linalg.inv(covariance)
    for own, evidence in zip(every, found, strict=True):
        assert evidence.shape == (len(own.options), 1, 2)
        for option, side in itertools.product((0, len(own.options) - 1), (0, 1)):
            part = own.additions[option]
            moved = shared.whitened(shared.moved_mm(part))[rows] * (3.0 * part.prior_sigma)
            moved = moved * (inside == bool(side))[:, None]
            matrix = np.eye(len(part)) + moved.T @ precision @ moved
            along = moved.T @ precision @ target
            expected = 0.5 * along @ np.linalg.solve(matrix, along) - 0.5 * np.linalg.slogdet(matrix)[1]
            expected += own.log_odds[option]
            assert evidence[option, 0, side] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_curves_are_made_once_for_all_fits(shared: Projection) -> None:
    first = candidate_effects(shared.context, shared, ["joint_error_map", "joint_compliance"]).candidates
    again = candidate_effects(shared.context, shared, ["joint_error_map", "joint_compliance"], like=first).candidates
    for own, other in zip(first, again, strict=True):
        for a, b in zip(own.additions, other.additions, strict=True):
            assert a.has_columns_of(b)
            assert (a is b) == (own.family == "joint_error_map")
