"""Detection: tests of whether simulation and measurement disagree beyond chance, and on which variables it depends.

The test statistic of every term is its score. The null distribution of the scores is obtained from the residuals with
the signs of whole groups of samples drawn at random (wild bootstrap: Wu, Annals of Statistics 14, 1986; score tests by
sign flips: Hemerik, Goeman and Finos, JRSS B 82, 2020). Sign flips preserve the sizes of the residuals, their outliers
and the correlation of neighbours, and remove only dependence on variables. Each of the many terms is compared with the
largest score of every draw (Westfall and Young 1993), which corrects for all tests, however correlated they are.

Errors far smaller than the stated noise of the fixes are not a disagreement. They only reflect that build tolerances
constrain a fit more than its noise requires.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

from calibration.gap.formulas.grammar import Grammar
from calibration.gap.formulas.terms import Kind
from calibration.gap.projected.projection import Integers, Projection
from calibration.gap.result import Disagreement
from calibration.numerics.statistics import chance_beyond
from calibration.observations import Floats

FAR = 1e-12  # p-value of the residuals below which no single effect, nor a few more, will explain them
_DRAWS = 999
_ENOUGH = 10  # draws beyond a score required for an empirical p-value; with fewer, a tail is extrapolated
_QUIET = 0.45  # RMS of the residuals, relative to the stated noise, below which there is no disagreement
_ALARM = 0.005  # half of the allowed false alarm rate, as the effects of the library may raise false alarms too
_LISTED = 0.05
_MOST = 10
# Shares of the false alarm rate: of the largest score of each kind of term, of the sum of all scores, and of neighbour
# tests along each of three variables.
_LARGEST: Mapping[Kind, float] = {"single": 0.4, "crossing": 0.15, "product": 0.15}
_TOGETHER = 0.15
_NEIGHBOURS = 0.05

_NEAREST = 4
_CORRELATED = 0.1  # share of the noise variance that neighbours may have in common: air, a tripod in the sun
_LEAST = 30  # smallest number of pairs
_LEAST_MM = 1e-6


@dataclass(frozen=True)
class Detection:
    """Result of the tests.

    Attributes:
        p: p-value of all tests together, under the hypothesis that nothing is missing.
        disagreements: source and variable, the most significant first, each with a p-value corrected for all tests.
            Values far below 1/1000 are from an extrapolated normal tail and are useful only for ranking.
    """

    p: float
    disagreements: tuple[Disagreement, ...]

    @property
    def significant(self) -> bool:
        """True if something is missing."""
        return self.p < _ALARM


def detect(grammar: Grammar, rng: np.random.Generator) -> Detection:
    """Test all terms of the grammar, and the correlation of neighbours.

    Args:
        grammar: the terms and their scores.
        rng: random generator for the signs.
    """
    is_quiet = float(np.mean(grammar.projection.residual**2)) < _QUIET**2
    if is_quiet or not grammar.terms:
        return Detection(1.0, ())
    groups = len(grammar.by_group)
    signs = 2.0 * rng.integers(0, 2, (_DRAWS, groups)) - 1.0
    lost = _sign_flip_factor(grammar)
    scores, chance = np.abs(grammar.score), np.abs(signs @ grammar.by_group) * lost
    kinds = np.array([term.kind for term in grammar.terms])
    p = np.ones(len(scores))
    for kind, share in _LARGEST.items():
        own = kinds == kind
        if own.any():
            p[own] = _p_of_largest(scores[own], chance[:, own].max(axis=1)) / share
    least = 0.5 ** (groups - 1)  # probability that all signs agree
    p = np.clip(p, least, 1.0)
    together = max(_p_of_sum(float(scores @ scores), (chance**2).sum(axis=1)) / _TOGETHER, least)
    listed: dict[tuple[str, str], Disagreement] = {}
    for i in np.lexsort((-scores, p)).tolist():
        term = grammar.terms[i]
        key = term.source.where, term.variable.topic
        if p[i] < _LISTED and len(listed) < _MOST:
            listed.setdefault(key, Disagreement(*key, float(p[i])))
    alarm = min(float(p.min()), together)
    if alarm < _ALARM:
        return Detection(alarm, tuple(listed.values()))
    for along in neighbour_tests(grammar.projection, rng, _DRAWS):  # for errors that no term describes
        alike = max(_p_of_sum(along.shared, along.chance * lost**2) / _NEIGHBOURS, least)
        alarm = min(alarm, alike)
        if alike < _LISTED:
            listed.setdefault((along.where, along.variable), Disagreement(along.where, along.variable, alike))
    return Detection(alarm, tuple(sorted(listed.values(), key=lambda d: d.p)[:_MOST]))


def _sign_flip_factor(grammar: Grammar) -> float:
    """Return the factor that scales residuals with flipped signs to the size of the noise.

    The fit of the kinematics removes some directions from the residuals. An effect's column has no component in them,
    so its score is not reduced. With flipped signs, however, the residuals are spread over all directions.
    """
    projection = grammar.projection
    taken = projection.without_kinematics.degrees_of_freedom
    return 1.0 / math.sqrt(max(1.0 - taken / len(projection.target), 0.5))


def _p_of_largest(scores: Floats, chance: Floats) -> Floats:
    """Return (k,) p-values of scores (k,) against the largest score of each draw (draws,)."""
    ordered = np.sort(chance)
    beyond = len(ordered) - np.searchsorted(ordered, scores, side="left")
    share = (beyond + 1.0) / (len(ordered) + 1.0)
    # The tail of the maximum of many normal numbers is proportional to that of a single one.
    edge = float(log_ndtr(-ordered[-_ENOUGH]))
    tail = np.exp(np.minimum(log_ndtr(-scores) - edge, 0.0)) * (_ENOUGH + 1.0) / (len(ordered) + 1.0)
    return np.where(beyond >= _ENOUGH, share, np.minimum(tail, share))


def _p_of_sum(total: float, chance: Floats) -> float:
    """Return the p-value of a sum of squares against those of the draws (draws,), with a gamma tail."""
    beyond = int((chance >= total).sum())
    share = (beyond + 1.0) / (len(chance) + 1.0)
    if beyond >= _ENOUGH:
        return share
    return min(share, chance_beyond(total, chance))


@dataclass(frozen=True)
class NeighbourTest:
    """Products of neighbours' residuals along one variable.

    Attributes:
        where, variable: source and variable, as for a disagreement.
        shared: sum of the products of neighbours' residuals, minus what correlated noise explains.
        chance: (draws,) the sums for random signs, without correlation of neighbours.
    """

    where: str
    variable: str
    shared: float
    chance: Floats


def neighbour_tests(projection: Projection, rng: np.random.Generator, draws: int) -> Iterator[NeighbourTest]:
    """Test whether errors of neighbouring samples are correlated, independent of any formula.

    Terms only find errors that they describe. An error that oscillates with time, ripples with the range or occurs in
    one corner of the work volume may match no term and look like excess noise. However, noise is independent from
    sample to sample, while an error that depends on a variable changes slowly with it. Neighbours are taken along time,
    along the range (errors along the line of sight), and in the work volume. Pairs within a group are left out, as
    fixes of a standstill share the errors of its readings.

    Args:
        projection: the projection with the residual.
        rng: random generator for the signs of groups.
        draws: number of draws.

    Yields:
        The result for each of the three variables.
    """
    residual = projection.residual.reshape(-1, 3)
    groups, group = np.unique(projection.groups, return_inverse=True)
    signs = 2.0 * rng.integers(0, 2, (draws, len(groups))) - 1.0
    # Positions of the model, as measured positions of a prism that stands still would be neighbours by their noise.
    place_mm = projection.samples.position_mm - projection.error_mm
    range_mm = np.linalg.norm(place_mm, axis=1)[:, None]
    sight = place_mm / np.maximum(range_mm, _LEAST_MM)
    time_s = projection.samples.average(projection.context.extra("time_s")[:, None])
    for where, variable, at, error in (
        ("base", "time", time_s, residual),
        ("station", "range", range_mm, (residual * sight).sum(axis=1)[:, None]),
        ("station", "place", place_mm, residual),
    ):
        a, b = _pairs(at, group)
        if len(a) < _LEAST:
            continue
        product = (error[a] * error[b]).sum(axis=1)
        between = coo_array((product, (group[a], group[b])), shape=(len(groups), len(groups))).tocsr()
        sizes = 0.5 * ((error[a] ** 2).sum(axis=1) + (error[b] ** 2).sum(axis=1))
        yield NeighbourTest(
            where,
            variable,
            float(product.sum() - _CORRELATED * sizes.sum()),
            ((signs @ between) * signs).sum(axis=1),
        )


def _pairs(at: Floats, group: Integers) -> tuple[Integers, Integers]:
    """Return each pair of a sample and one of its nearest neighbours once, without pairs within a group (m,)."""
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    if len(known) <= _NEAREST:
        return known[:0], known[:0]
    nearest = cKDTree(at[known]).query(at[known], _NEAREST + 1)[1]
    pairs = np.column_stack([np.repeat(known, _NEAREST + 1), known[nearest].ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = pairs[group[pairs[:, 0]] != group[pairs[:, 1]]].T
    return a, b
