"""Hierarchical estimate of one quantity over many rigs: common mean, spread between rigs, and shrunken values.

Rig i has measured y_i with standard error s_i. Its true value is drawn from N(mean, spread^2), so that
y_i ~ N(mean, spread^2 + s_i^2). The spread is estimated by Paule and Mandel (J. Res. Natl. Bur. Stand. 87, 1982): the
weighted sum of squares about the weighted mean equals its degrees of freedom. Outlying rigs are found first by median
and MAD, then relative to the estimate without them, until the set of outliers no longer changes.

With few rigs the spread is uncertain, and a value that is shrunk too far towards the fleet gets too small a standard
error. The mean and each rig's value are therefore averaged over all plausible spreads, weighted by the restricted
likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import stdtr

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST_RIGS = 5  # fewer rigs do not determine a spread
_ROUNDS = 20
_LEVEL = 0.01  # probability that any rig is classified as an outlier if there are none
_TINY = float(np.finfo(np.float64).tiny)
_GRID = 200  # number of spreads to average over
_REACH = 3.0  # largest spread considered, in standard deviations of the values
_MAD = 1.4826  # sigma divided by MAD for a normal distribution
_LEAST_PRECISION = 1e-9  # of a direction, relative to its parameters; a smaller precision is a rounding error
_LEAST_GAIN = 0.19  # least share of the data in the posterior precision: sigma below 0.9 of the prior's


@dataclass(frozen=True)
class FleetEstimate:
    """Estimate of one quantity over n rigs; rigs that have not measured it have NaN.

    Attributes:
        mean, mean_sigma: mean of the fleet without outliers, and its standard error.
        spread: standard deviation between rigs; 0 if measurement errors explain all differences.
        rigs: number of rigs used for the mean and the spread.
        p_common: probability of so large a mean if the true mean is 0.
        estimate, sigma: (n,) value of each rig given its own measurement and the fleet, and its standard error; an
            outlier keeps its own measurement.
        deviation: (n,) deviation of each measurement from the fleet's mean, in expected standard deviations.
        p: (n,) probability of so large a deviation.
        is_outlier: (n,) True for a rig that does not belong to the fleet in this quantity.
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
    """Estimate the common mean of rigs, their spread, and each rig's value given the fleet.

    Args:
        value: (n,) measured values; NaN for a rig that has not measured it.
        sigma: (n,) standard errors, positive.

    Returns:
        The estimate; None if fewer than LEAST_RIGS rigs have measured the quantity.
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
    expected = s**2 + between + np.where(outside, mean_variance, -mean_variance)  # the mean includes the rigs inside
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
    """Return the mean, its variance, and the variance between rigs."""

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
    """Return the mean, its variance, each rig's value given all rigs, and its variance, averaged over spreads."""
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
    drawn = s**2 / variance  # shrinkage towards the mean
    given = y + drawn * (mean[:, None] - y)
    given_variance = s**2 * (1.0 - drawn) + drawn**2 / total[:, None]
    best, best_given = float(weight @ mean), weight @ given
    mean_variance = float(weight @ (1.0 / total + (mean - best) ** 2))
    return best, mean_variance, best_given, weight @ (given_variance + (given - best_given) ** 2)


def _far(y: Floats, s: Floats, mean: float, mean_variance: float, between: float, rigs: int) -> Flags:
    """Return an (n,) mask of rigs that deviate more than chance explains, corrected for the number of rigs."""
    p = _two_sided((y - mean) / np.sqrt(s**2 + between + mean_variance), rigs - 1)
    far: Flags = p < _LEVEL / len(y)
    return far


def _two_sided(deviation: Floats | float, degrees: int) -> Floats:
    return np.asarray(2.0 * stdtr(max(degrees, 1), -np.abs(deviation)), dtype=np.float64)


def widened_prior(value: Floats, covariance: Floats, prior_sigma: Floats, factor: float) -> tuple[Floats, Floats]:
    """Return the posterior of parameters for a wider prior about 0.

    For correlated parameters, the prior of one parameter also acts on the others: a constant that is far from its
    nominal value shifts them. The full covariance allows that influence to be removed.

    Args:
        value: (p,) posterior means.
        covariance: (p, p) posterior covariance.
        prior_sigma: (p,) standard deviations of the prior used in the fit; infinity for no prior.
        factor: factor by which the prior is widened.

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
    """Return the estimates from the data alone of parameters whose posterior has a prior about 0.

    Rigs that share a prior are not independent of it, so it must be removed before they are combined. Correlations are
    ignored: each parameter is treated by its marginal posterior. The prior must therefore be wide (`widened_prior`).

    Args:
        value: (n,) posterior means.
        sigma: (n,) posterior standard errors.
        prior_sigma: (n,) standard deviations of the prior; infinity for no prior.

    Returns:
        (n,) values and (n,) standard errors; NaN where the data added hardly anything to the prior.
    """
    precision, prior = 1.0 / sigma**2, 1.0 / prior_sigma**2
    own = precision - prior
    is_told = own > _LEAST_GAIN * precision
    safe = np.where(is_told, own, 1.0)
    return np.where(is_told, value * precision / safe, np.nan), np.where(is_told, 1.0 / np.sqrt(safe), np.nan)


def false_discovery_threshold(p: Floats, rate: float) -> float:
    """Return the largest significant p at a false discovery rate, after Benjamini and Hochberg.

    Source: J. R. Stat. Soc. B 57, 1995.

    Args:
        p: p-values of any shape; NaN is ignored.
        rate: greatest expected share of false discoveries among the significant values.

    Returns:
        The threshold; 0 if no value is significant.
    """
    known = np.sort(p[np.isfinite(p)])
    passing = np.flatnonzero(known <= rate * np.arange(1, len(known) + 1) / max(len(known), 1))
    return float(known[passing[-1]]) if len(passing) else 0.0
