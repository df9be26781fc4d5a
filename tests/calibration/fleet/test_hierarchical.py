"""What rigs have in common: mean, spread, rigs given the others, and rigs that do not belong."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.fleet.hierarchical import false_discovery_threshold, fleet_estimate, widened_prior, without_prior


def simulated(rigs: int, mean: float, spread: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth, measurement and standard error of each rig; errors differ by a factor of ten."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(mean, spread, rigs)
    sigma = rng.uniform(0.3, 3.0, rigs)
    return truth, rng.normal(truth, sigma), sigma


def test_mean_and_spread_are_found_and_their_errors_are_true() -> None:
    pulls, spreads = [], []
    for seed in range(200):
        _, value, sigma = simulated(60, 5.0, 2.0, seed)
        found = fleet_estimate(value, sigma)
        assert found is not None
        pulls.append((found.mean - 5.0) / found.mean_sigma)
        spreads.append(found.spread)
    assert abs(np.mean(pulls)) < 0.25
    assert 0.85 < np.std(pulls) < 1.15
    assert 1.9 < np.mean(spreads) < 2.1


def test_rigs_given_the_fleet_are_nearer_to_the_truth_and_their_errors_are_true() -> None:
    own, given, pulls = [], [], []
    for seed in range(100):
        truth, value, sigma = simulated(60, 5.0, 1.0, seed)
        found = fleet_estimate(value, sigma)
        assert found is not None
        own.append(np.mean((value - truth) ** 2))
        given.append(np.mean((found.estimate - truth) ** 2))
        pulls.append((found.estimate - truth) / found.sigma)
    assert np.mean(given) < 0.4 * np.mean(own)
    assert 0.9 < np.std(pulls) < 1.15


def test_no_spread_is_claimed_where_errors_explain_all() -> None:
    found = [fleet_estimate(*simulated(60, 5.0, 0.0, seed)[1:]) for seed in range(100)]
    spreads = [each.spread for each in found if each is not None]
    assert np.median(spreads) < 0.3


def test_outliers_are_found_and_leave_the_others_alone() -> None:
    found_all, false = 0, 0
    for seed in range(100):
        _, value, sigma = simulated(50, 5.0, 1.0, seed)
        value[:3] += 30.0
        found = fleet_estimate(value, sigma)
        assert found is not None
        found_all += bool(found.is_outlier[:3].all())
        false += int(found.is_outlier[3:].sum())
        assert abs(found.mean - 5.0) < 1.2
        assert found.spread < 2.0
        np.testing.assert_array_equal(found.estimate[:3], value[:3])
    assert found_all == 100
    assert false <= 5


def test_alarms_without_outliers_are_as_rare_as_said() -> None:
    fleets = [fleet_estimate(*simulated(50, 0.0, 1.0, seed)[1:]) for seed in range(400)]
    alarms = sum(bool(found.is_outlier.any()) for found in fleets if found is not None)
    assert alarms <= 15  # 4 expected at a level of 1 %
    common = sum(found.p_common < 0.01 for found in fleets if found is not None)
    assert common <= 15


def test_too_few_rigs_and_rigs_without_the_quantity() -> None:
    assert fleet_estimate(np.array([1.0, 2.0, np.nan, 3.0, 4.0]), np.ones(5)) is None
    found = fleet_estimate(np.array([1.0, 2.0, np.nan, 3.0, 4.0, 2.0]), np.ones(6))
    assert found is not None
    assert (found.rigs, np.isnan(found.estimate).tolist().index(True)) == (5, 2)


def test_a_prior_is_taken_out() -> None:
    own, sigma, prior = 4.0, 1.0, 2.0
    precision = 1 / sigma**2 + 1 / prior**2
    value, error = without_prior(
        np.array([own / sigma**2 / precision, 0.1, 3.0]),
        np.array([precision**-0.5, 1.95, 0.5]),
        np.array([prior, 2.0, np.inf]),
    )
    np.testing.assert_allclose((value[0], error[0]), (own, sigma))
    assert np.isnan(value[1])
    assert (value[2], error[2]) == pytest.approx((3.0, 0.5))


def test_what_a_prior_says_of_one_parameter_is_undone_in_those_that_are_known_with_it() -> None:
    rng = np.random.default_rng(0)
    design = rng.normal(size=(12, 3))
    design[:, 1] = design[:, 0] + 0.2 * design[:, 1]
    truth, prior = np.array([12.0, -3.0, 1.0]), np.array([2.0, 5.0, np.inf])
    data = design @ truth

    def posterior(sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        covariance = np.linalg.inv(design.T @ design + np.diag(1.0 / sigma**2))
        return covariance @ design.T @ data, covariance

    value, covariance = posterior(prior)
    wide, expected = posterior(10.0 * prior)
    found, sigma = widened_prior(value, covariance, prior, 10.0)
    np.testing.assert_allclose(found, wide)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(expected)))
    assert abs(found[1] - truth[1]) < 0.1 * abs(value[1] - truth[1])


def test_false_discoveries_are_a_small_share() -> None:
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.uniform(0, 1, 900), np.full(100, 1e-6)])
    threshold = false_discovery_threshold(p, 0.05)
    assert threshold >= 1e-6
    assert (p[:900] <= threshold).sum() <= 12
    assert false_discovery_threshold(rng.uniform(0.2, 1, 100), 0.05) == 0.0
    assert false_discovery_threshold(np.array([np.nan]), 0.05) == 0.0
