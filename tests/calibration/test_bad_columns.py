"""Columns that were written otherwise than they are read: rounded, in another unit, of another clock or origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.gap.workflow import find_gap
from calibration.model import CalibratedModel
from calibration.observations import Observations, parse_observations
from calibration.pipeline import identify
from simulators.dataset import simulate_observations
from tests.calibration.conftest import Session, rig_text

Change = Callable[[Observations], Observations]


def calibrated(session: Session, rows: Observations) -> CalibratedModel:
    return identify(session.rig, rig_text("swdt82"), rows, effects="none")


def with_sigma(sigma_mm: float) -> Change:
    return lambda o: replace(o, sigma_mm=np.full_like(o.position_mm, sigma_mm))


@pytest.mark.parametrize(
    ("sigma_mm", "words"), [(0.3, "whether the sigma columns are too small"), (9.0, "check the sigma columns")]
)
def test_sigma_columns_that_are_far_off_are_named(session: Session, sigma_mm: float, words: str) -> None:
    (warning,) = calibrated(session, with_sigma(sigma_mm)(session.training)).warnings
    assert words in warning


def test_sigmas_that_are_too_large_do_not_make_a_gap(session: Session) -> None:
    gap = find_gap(session.rig, rig_text("swdt82"), with_sigma(9.0)(session.training))
    assert gap.verdict == "none"
    assert [w for w in gap.warnings if "too large ones make a loose fit" in w] == list(gap.warnings)


def test_data_without_noise_leave_nothing_that_lacks_a_name(session: Session) -> None:
    data = simulate_observations(session.truth, 250, 7, prisms_per_pose="one", noise_mm=0.0, joint_noise=False)
    model = identify(
        session.rig, rig_text("swdt82"), parse_observations(data.csv_text().encode(), session.rig, "exact.csv")
    )
    (warning,) = model.warnings
    assert "data computed without noise do so too" in warning
