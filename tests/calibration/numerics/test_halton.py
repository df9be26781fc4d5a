from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from calibration.numerics.statistics import halton


@pytest.mark.parametrize("dimensions", [1, 2, 11])
def test_points_are_those_of_scipy(dimensions: int) -> None:
    expected = qmc.Halton(dimensions, scramble=False).random(300)
    np.testing.assert_allclose(halton(dimensions, 300), expected, rtol=0.0, atol=1e-14)
