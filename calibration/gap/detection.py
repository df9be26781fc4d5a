"""Detection: tests of whether simulation and measurement disagree beyond chance, and on what that depends.

The test of every term is its score. What scores are like by chance the residuals say themselves: with the signs of
whole groups of samples drawn at random (wild bootstrap: Wu, Annals of Statistics 14, 1986; score tests by sign flips:
Hemerik, Goeman and Finos, JRSS B 82, 2020) they keep their sizes from source to source, their outliers and what they
share with their neighbours, and lose only what depends on anything. Each of the many terms is held to the largest
score of every draw (Westfall and Young 1993), and so pays for all tests, however alike they are.

Errors far smaller than the noise that the fixes are said to have are no disagreement: they show how build tolerances
hold a fit that is looser than it need be.
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
from calibration.gap.projection import Integers, Projection
from calibration.gap.result import Disagreement
from calibration.numerics.statistics import chance_beyond
from calibration.observations import Floats

FAR = 1e-12  # p-value of the remaining errors, below which neither one effect nor a few more will explain them
_DRAWS = 999
_ENOUGH = 10  # draws beyond a score, of which a share is a probability; with fewer a tail goes on from there
_QUIET = 0.45  # of the noise that the fixes are said to have
_ALARM = 0.005  # half of what false alarms may be: the library may raise some too
_LISTED = 0.05
_MOST = 10
# Of the chance of a false alarm: what the largest score of each kind of term has, what all scores together have, and
# what neighbours share along each of three variables.
_LARGEST: Mapping[Kind, float] = {"single": 0.4, "crossing": 0.15, "product": 0.15}
_TOGETHER = 0.15
_NEIGHBOURS = 0.05

_NEAREST = 4
_WANDERS = 0.1  # share of the variance that noise may share with its neighbours: air, a tripod in the sun
_LEAST = 30  # pairs
_LEAST_MM = 1e-6


@dataclass(frozen=True)
class Detection:
    """Result of the tests.

    Attributes:
        p: p-value of all scores together, where nothing is missing.
        disagreements: source and variable, the most significant first, each p corrected for all tests; values far
            smaller than one in a thousand are the tail of a normal number and only rank them.
    """

    p: float
    disagreements: tuple[Disagreement, ...]

    @property
    def significant(self) -> bool:
        """True if something is missing."""
        return self.p < _ALARM


def detect(grammar: Grammar, rng: np.random.Generator) -> Detection:
    """Test everything that the grammar has words for.

    Args:
        grammar: the terms and their scores.
        rng: draws the signs.
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
    least = 0.5 ** (groups - 1)  # as often all signs agree
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
    for along in neighbour_tests(grammar.projection, rng, _DRAWS):  # for what no term has words for
        alike = max(_p_of_sum(along.shared, along.chance * lost**2) / _NEIGHBOURS, least)
        alarm = min(alarm, alike)
        if alike < _LISTED:
            listed.setdefault((along.where, along.variable), Disagreement(along.where, along.variable, alike))
    return Detection(alarm, tuple(sorted(listed.values(), key=lambda d: d.p)[:_MOST]))


def _sign_flip_factor(grammar: Grammar) -> float:
    """Return the factor that makes residuals with flipped signs as large as the noise.

    The fit of the kinematics takes some directions out of the residuals, in which an effect's column has nothing: its
    score is none the smaller for it, but with flipped signs the rest is spread over all directions.
    """
    projection = grammar.projection
    taken = projection.without_kinematics.degrees_of_freedom
    return 1.0 / math.sqrt(max(1.0 - taken / len(projection.target), 0.5))


def _p_of_largest(scores: Floats, chance: Floats) -> Floats:
    """Return (k,) p-values of scores (k,) against the largest score of each draw (draws,)."""
    ordered = np.sort(chance)
    beyond = len(ordered) - np.searchsorted(ordered, scores, side="left")
    share = (beyond + 1.0) / (len(ordered) + 1.0)
    # The tail of the largest of many normal numbers is proportional to that of one.
    edge = float(log_ndtr(-ordered[-_ENOUGH]))
    tail = np.exp(np.minimum(log_ndtr(-scores) - edge, 0.0)) * (_ENOUGH + 1.0) / (len(ordered) + 1.0)
    return np.where(beyond >= _ENOUGH, share, np.minimum(tail, share))


def _p_of_sum(total: float, chance: Floats) -> float:
    """Return the p-value of a sum of squares against those of the draws (draws,), whose tail is a gamma one."""
    beyond = int((chance >= total).sum())
    share = (beyond + 1.0) / (len(chance) + 1.0)
    if beyond >= _ENOUGH:
        return share
    return min(share, chance_beyond(total, chance))


@dataclass(frozen=True)
class NeighbourTest:
    """Products of neighbours' residuals along one variable.

    Attributes:
        where, variable: source and variable, as of a disagreement.
        shared: products of the residuals of neighbours, summed, beyond what noise may share.
        chance: (draws,) the same where neighbours have nothing in common.
    """

    where: str
    variable: str
    shared: float
    chance: Floats


def neighbour_tests(projection: Projection, rng: np.random.Generator, draws: int) -> Iterator[NeighbourTest]:
    """Test whether errors go together in neighbouring samples, whatever the formula.

    Terms find what they have words for. An error that swings with the time, ripples with the range or sits in one
    corner of the work volume may have none and look like noise that is larger than it should be; but noise is
    independent from sample to sample, and an error that depends on something varies slowly with it. Neighbours are
    taken along the time, along the range (errors along the line of sight), and in the work volume; pairs within a group
    are left out: fixes of a standstill share the errors of its readings.

    Args:
        projection: whose residual.
        rng: draws the signs of groups.
        draws: how often.
    """
    residual = projection.residual.reshape(-1, 3)
    groups, group = np.unique(projection.groups, return_inverse=True)
    signs = 2.0 * rng.integers(0, 2, (draws, len(groups))) - 1.0
    # Where the model has them: as measured, fixes of a prism that stands still would be neighbours by their noise.
    place_mm = projection.samples.position_mm - projection.error_mm
    range_mm = np.linalg.norm(place_mm, axis=1)[:, None]
    sight = place_mm / np.maximum(range_mm, _LEAST_MM)
    time_s = projection.samples.average(projection.situation.extra("time_s")[:, None])
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
            float(product.sum() - _WANDERS * sizes.sum()),
            ((signs @ between) * signs).sum(axis=1),
        )


def _pairs(at: Floats, group: Integers) -> tuple[Integers, Integers]:
    """Return pairs of every sample and its nearest neighbours, each pair once, none within a group (m,)."""
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    if len(known) <= _NEAREST:
        return known[:0], known[:0]
    nearest = cKDTree(at[known]).query(at[known], _NEAREST + 1)[1]
    pairs = np.column_stack([np.repeat(known, _NEAREST + 1), known[nearest].ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = pairs[group[pairs[:, 0]] != group[pairs[:, 1]]].T
    return a, b
