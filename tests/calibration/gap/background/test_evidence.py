"""Evidence from products of columns is that of the rows themselves, and its greatest scales are found."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import check_grad
from scipy.stats import multivariate_normal

from calibration.gap.background.evidence import FixedAndScaled, Products, maximise_evidence

Floats = NDArray[np.float64]


def problem(seed: int, sizes: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return (200, 12) columns and (200,) rows: two fixed columns, two blocks of five, noise; sizes are of these."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((200, 12))
    scale = np.repeat([1.0, sizes[0], sizes[1]], [2, 5, 5])
    return columns, columns @ (scale * rng.standard_normal(12)) + sizes[2] * rng.standard_normal(200)


def products(columns: Floats, rows: Floats) -> Products:
    return Products(columns.T @ columns, columns.T @ rows, float(rows @ rows), len(rows), 1e-6)


@pytest.mark.parametrize("fixed", [0, 2, 7, 12])
def test_the_evidence_is_that_of_the_rows(fixed: int) -> None:
    columns, rows = problem(1, (0.5, 0.0, 1.0))
    sigma = np.repeat([1.0, 0.7, 0.2], [2, 5, 5])
    covariance = 1.3 * np.eye(200) + (columns * sigma**2) @ columns.T
    own = FixedAndScaled(products(columns, rows), np.arange(fixed), sigma[:fixed], np.arange(fixed, 12))
    value, _, _ = own.evidence(sigma[fixed:], 1.3)
    constant = 0.5 * len(rows) * np.log(2.0 * np.pi)
    assert value - constant == pytest.approx(multivariate_normal(cov=covariance).logpdf(rows), abs=1e-8)


@pytest.mark.parametrize("fixed", [0, 2, 7])
def test_its_slopes_are_those_of_its_values(fixed: int) -> None:
    own = products(*problem(2, (0.5, 0.1, 1.0)))
    model = FixedAndScaled(own, np.arange(fixed), np.full(fixed, 0.8), np.arange(fixed, 12))

    def value(theta: Floats) -> float:
        return model.evidence(np.exp(theta[:-1]), float(np.exp(theta[-1])))[0]

    def slope(theta: Floats) -> Floats:
        _, by_sigma, by_noise = model.evidence(np.exp(theta[:-1]), float(np.exp(theta[-1])))
        return np.append(by_sigma, by_noise)

    assert check_grad(value, slope, np.full(13 - fixed, -0.3)) < 1e-4


def test_scales_of_what_is_there_are_found_and_those_of_what_is_not_vanish() -> None:
    own = products(*problem(3, (2.0, 0.0, 0.5)))
    blocks = {"there": np.arange(2, 7), "not there": np.arange(7, 12)}
    found = maximise_evidence(own, np.arange(2), np.ones(2), blocks, dict.fromkeys(blocks, -1.0), 1.0, 1e-3)
    assert 1.0 < np.exp(found.log_scale["there"]) < 4.0
    assert np.exp(found.log_scale["not there"]) < 0.1
    assert found.noise == pytest.approx(0.25, rel=0.3)
