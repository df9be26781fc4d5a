"""The tail of a sample, against scipy.stats, which is too slow to import for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calibration.numerics.statistics import chance_beyond


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("freedom", [3, 200])
def test_the_tail_of_a_sample_is_that_of_a_gamma_distribution_with_its_moments(sign: float, freedom: int) -> None:
    draws = sign * np.random.default_rng(1).chisquare(freedom, size=999)
    for value in draws.mean() + np.array([-2.0, 0.0, 3.0, 8.0]) * draws.std():
        expected = stats.pearson3.sf(value, stats.skew(draws), draws.mean(), draws.std())
        assert chance_beyond(value, draws) == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_a_symmetric_sample_has_a_normal_tail_and_one_without_spread_tells_nothing() -> None:
    assert chance_beyond(3.0, np.array([-1.0, 1.0])) == pytest.approx(stats.norm.sf(3.0))
    assert chance_beyond(3.0, np.ones(5)) == 1.0
