"""A part of the rows that stands for all: no set-up is left out, however small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.identification.diagnosis import Quality, diagnose
from calibration.identification.linear_model import prior_precision
from calibration.identification.solve import place
from calibration.identification.start import draw_rows
from calibration.kinematics.chain import ChainData
from tests.calibration.conftest import Session, simulated
from tests.calibration.identification.sweeps.test_circles import joined_observations


def rows(setup: np.ndarray) -> ChainData:
    return ChainData(np.zeros((len(setup), 2)), np.zeros(len(setup), dtype=np.intp), setup.astype(np.intp))


def test_a_small_set_up_has_rows_enough_to_place_its_base() -> None:
    setup = np.r_[np.zeros(600), np.ones(12), np.full(4, 2)]
    position_mm = np.random.default_rng(0).normal(size=(len(setup), 3))
    for seed in range(20):
        picked = draw_rows(rows(setup), position_mm, 120, seed)
        assert 120 <= len(picked) <= 130
        assert (np.diff(picked) > 0).all()
        assert (setup[picked] == 1).sum() >= 6
        assert (setup[picked] == 2).sum() == 4


def test_a_set_up_whose_rows_lie_on_a_line_but_for_one_has_that_one() -> None:
    setup = np.r_[np.zeros(600), np.ones(40)]
    position_mm = np.random.default_rng(0).normal(size=(len(setup), 3))
    position_mm[600:639] = np.arange(39)[:, None] * [1.0, 2.0, 3.0]
    for seed in range(20):
        assert 639 in draw_rows(rows(setup), position_mm, 120, seed)


def test_few_rows_are_all_taken() -> None:
    assert draw_rows(rows(np.zeros(50)), np.zeros((50, 3)), 120, 0).tolist() == list(range(50))


def test_a_reversed_joint_is_named_beside_a_small_set_up(session: Session) -> None:
    joined = joined_observations([session.training, session.held_out, simulated(session.truth, 8, 9, setup="small")])
    reversed_ = replace(joined, joints={**joined.joints, "theta5": -joined.joints["theta5"]})
    chain, samples, start = place(session.rig, reversed_)
    found = diagnose(
        chain,
        samples,
        precision=prior_precision(chain, 1.0),
        before=Quality.of(chain, samples, start.x),
        tolerated_mm=10.0,
        at_once=1,
    )
    assert found is not None
    assert found.what == "theta5 runs the other way"
