"""A hierarchical estimate of one quantity over many rigs: common mean, spread between rigs, each rig given the others.

Rig i has measured y_i with standard error s_i; its true value is drawn from N(mean, spread^2), so that
y_i ~ N(mean, spread^2 + s_i^2). The spread is that of Paule and Mandel (J. Res. Natl. Bur. Stand. 87, 1982): the
weighted sum of squares about the weighted mean equals its degrees of freedom. Rigs that are too far off are found
first by median and MAD, then against the estimate without them, until the set is the same twice.

Few rigs tell well how large the spread is, and a rig that is drawn to the fleet too much looks surer than it is. So the
mean and each rig's value are averaged over the spreads that the data leave open, weighted by the restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import stdtr

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST_RIGS = 5  # fewer tell no spread
_ROUNDS = 20
_LEVEL = 0.01  # chance that any of the rigs is taken for an outlier where none is
_TINY = float(np.finfo(np.float64).tiny)
_GRID = 200  # spreads that are averaged over
_REACH = 3.0  # standard deviations of the values: larger spreads are out of the question
_MAD = 1.4826  # of a normal distribution: sigma over MAD
_LEAST_PRECISION = 1e-9  # of a direction, over that of its parameters: none is left but rounding
_LEAST_GAIN = 0.19  # of the posterior's precision must be the data's own: sigma below 0.9 of the prior's


@dataclass(frozen=True)
class FleetEstimate:
    """One quantity over n rigs; rigs without it have NaN.

    Attributes:
        mean, mean_sigma: of the fleet without outliers, and its standard error.
        spread: standard deviation between rigs; 0 where measurement errors explain all differences.
        rigs: how many rigs the mean and the spread are of.
        p_common: chance of so large a mean where the true one is 0.
        estimate, sigma: (n,) each rig's value given its own measurement and the fleet, and its standard error: an
            outlier keeps its own.
        deviation: (n,) own measurement from the fleet's mean, in standard deviations of what is expected.
        p: (n,) chance of so large a deviation.
        is_outlier: (n,) True where the rig is not of this fleet, in this quantity.
    """

    mean: float
    mean_sigma: float
    spread: float
    rigs: int
    p_common: float
    estimate: Floats
    sigma: Floats
    deviation: Floats
    p: Floats
    is_outlier: Flags


def fleet_estimate(value: Floats, sigma: Floats) -> FleetEstimate | None:
    """Estimate what rigs have in common.

    Args:
        value: (n,) measured; NaN where a rig has not measured it.
        sigma: (n,) its standard error, positive.

    Returns:
        The estimate; None where fewer than LEAST_RIGS rigs have measured it.
    """
    there = np.isfinite(value) & np.isfinite(sigma) & (sigma > 0)
    if there.sum() < LEAST_RIGS:
        return None
    y, s = value[there], sigma[there]
    middle = float(np.median(y))
    robust = max((_MAD * float(np.median(np.abs(y - middle)))) ** 2 - float(np.median(s**2)), 0.0)
    outside = _far(y, s, middle, 0.0, robust, len(y))
    for _ in range(_ROUNDS):
        mean, mean_variance, between = _fit(y[~outside], s[~outside])
        again = _far(y, s, mean, mean_variance, between, int((~outside).sum()))
        if (again == outside).all() or (~again).sum() < LEAST_RIGS:
            break
        outside = again
    inside = int((~outside).sum())
    expected = s**2 + between + np.where(outside, mean_variance, -mean_variance)  # the mean holds those inside
    deviation = (y - mean) / np.sqrt(np.maximum(expected, 1e-12 * s**2))
    mean, mean_variance, given, given_variance = _averaged(y[~outside], s[~outside])
    estimate, variance = y.copy(), s**2
    estimate[~outside], variance[~outside] = given, given_variance
    full = np.full(len(value), np.nan)

    def spread_out(values: Floats) -> Floats:
        out = full.copy()
        out[there] = values
        return out

    flags = np.zeros(len(value), dtype=bool)
    flags[there] = outside
    return FleetEstimate(
        mean,
        float(np.sqrt(mean_variance)),
        float(np.sqrt(between)),
        inside,
        _two_sided(mean / np.sqrt(mean_variance), inside - 1).item(),
        spread_out(estimate),
        spread_out(np.sqrt(variance)),
        spread_out(deviation),
        spread_out(_two_sided(deviation, inside - 1)),
        flags,
    )


def _fit(y: Floats, s: Floats) -> tuple[float, float, float]:
    """Return mean, its variance, and the variance between rigs."""

    def excess(between: float) -> float:
        w = 1.0 / (s**2 + between)
        mean = float((w * y).sum() / w.sum())
        return float((w * (y - mean) ** 2).sum()) - (len(y) - 1)

    between, most = 0.0, float(np.var(y, ddof=1)) + _TINY
    if excess(0.0) > 0.0:
        while excess(most) > 0.0:  # by rounding
            most *= 2.0
        between = brentq(excess, 0.0, most, xtol=_TINY, maxiter=1000)
    w = 1.0 / (s**2 + between)
    return float((w * y).sum() / w.sum()), float(1.0 / w.sum()), between


def _averaged(y: Floats, s: Floats) -> tuple[float, float, Floats, Floats]:
    """Return mean, its variance, each rig's value given all, and its variance, averaged over possible spreads."""
    reach = _REACH * float(np.std(y, ddof=1)) + float(s.min())
    spread = reach * ((np.arange(_GRID) + 0.5) / _GRID)[:, None]
    variance = s**2 + spread**2  # (spreads, rigs)
    w = 1.0 / variance
    total = w.sum(axis=1)
    mean = (w * y).sum(axis=1) / total
    squares = (w * (y - mean[:, None]) ** 2).sum(axis=1)
    log_likelihood = -0.5 * (np.log(variance).sum(axis=1) + np.log(total) + squares)
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    drawn = s**2 / variance  # to the mean
    given = y + drawn * (mean[:, None] - y)
    given_variance = s**2 * (1.0 - drawn) + drawn**2 / total[:, None]
    best, best_given = float(weight @ mean), weight @ given
    mean_variance = float(weight @ (1.0 / total + (mean - best) ** 2))
    return best, mean_variance, best_given, weight @ (given_variance + (given - best_given) ** 2)


def _far(y: Floats, s: Floats, mean: float, mean_variance: float, between: float, rigs: int) -> Flags:
    """Return which rigs are farther off than chance allows any of them to be."""
    p = _two_sided((y - mean) / np.sqrt(s**2 + between + mean_variance), rigs - 1)
    far: Flags = p < _LEVEL / len(y)
    return far


def _two_sided(deviation: Floats | float, degrees: int) -> Floats:
    return np.asarray(2.0 * stdtr(max(degrees, 1), -np.abs(deviation)), dtype=np.float64)


def widened_prior(value: Floats, covariance: Floats, prior_sigma: Floats, factor: float) -> tuple[Floats, Floats]:
    """Return the posterior of parameters as it would be with a wider prior about 0.

    Parameters that are known together only share what the prior says of one of them: a constant that is far from its
    drawing pulls others along. With the whole covariance that is undone.

    Args:
        value: (p,) posterior means.
        covariance: (p, p) of them.
        prior_sigma: (p,) of the prior that they were fitted with; infinity for none.
        factor: by which it is widened.

    Returns:
        (p,) means and (p,) standard errors.
    """
    scale = np.sqrt(np.diag(covariance))
    own = np.linalg.inv(covariance / np.outer(scale, scale))
    taken = (scale / prior_sigma) ** 2 * (1.0 - factor**-2)
    size, axes = np.linalg.eigh(0.5 * (own + own.T) - np.diag(taken))
    wide = (axes / np.maximum(size, _LEAST_PRECISION)) @ axes.T
    return scale * (wide @ own @ (value / scale)), scale * np.sqrt(np.diag(wide))


def without_prior(value: Floats, sigma: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Return what data alone say of parameters whose posterior has a prior about 0.

    Rigs that share a prior are no independent witnesses of what it says. Correlations are passed over, so the prior is
    to be wide (`widened_prior`): of a parameter that is known only together with others, the marginal posterior counts.

    Args:
        value: (n,) posterior mean.
        sigma: (n,) posterior standard error.
        prior_sigma: (n,) of the prior; infinity for none.

    Returns:
        (n,) values and (n,) standard errors, NaN where the data hardly added to the prior.
    """
    precision, prior = 1.0 / sigma**2, 1.0 / prior_sigma**2
    own = precision - prior
    is_told = own > _LEAST_GAIN * precision
    safe = np.where(is_told, own, 1.0)
    return np.where(is_told, value * precision / safe, np.nan), np.where(is_told, 1.0 / np.sqrt(safe), np.nan)


def false_discovery_threshold(p: Floats, rate: float) -> float:
    """Return the largest p that counts, so that at most a share `rate` of what counts is chance.

    Benjamini and Hochberg (J. R. Stat. Soc. B 57, 1995). NaN is passed over; 0 where nothing counts.
    """
    known = np.sort(p[np.isfinite(p)])
    passing = np.flatnonzero(known <= rate * np.arange(1, len(known) + 1) / max(len(known), 1))
    return float(known[passing[-1]]) if len(passing) else 0.0
