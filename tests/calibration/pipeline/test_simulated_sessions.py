"""The accuracy that is promised: held-out poses of eight machines, close to what noise allows. A bench has twenty."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.simulated_sessions import Outcome, session

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [session(seed) for seed in range(1000, 1008)]


def test_held_out_error_is_close_to_the_noise_floor(outcomes: list[Outcome]) -> None:
    ratios = np.array([o.ratio for o in outcomes])
    assert ratios.mean() <= 1.04
    assert ratios.max() <= 1.12
    assert all(o.nominal_mm > 2.0 * o.geometric_mm for o in outcomes)


def test_predicted_sigma_is_the_size_of_the_errors(outcomes: list[Outcome]) -> None:
    assert all(0.8 < o.chi_square < 1.2 for o in outcomes)
    assert 0.9 < np.mean([o.chi_square for o in outcomes]) < 1.1
    assert 0.94 < np.mean([o.inside for o in outcomes]) < 0.97


def test_the_noise_is_estimated_and_not_assumed(outcomes: list[Outcome]) -> None:
    # The rig's station claims 1.0 to 2.5 mm; 3 mm were drawn.
    assert all(o.estimated_noise_mm == pytest.approx(o.noise_mm, rel=0.12) for o in outcomes)
