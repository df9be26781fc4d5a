"""Whether a simulation and its measurement disagree beyond chance, and on what the disagreement depends.

The test of every term is its score. What scores are like by chance the residuals say themselves: with the signs of
whole groups of samples drawn at random (wild bootstrap: Wu, Annals of Statistics 14, 1986; score tests by sign flips:
Hemerik, Goeman and Finos, JRSS B 82, 2020) they keep their sizes from place to place, their outliers and what they
share with their neighbours, and lose only what depends on anything. Each of the many terms is held to the largest
score of every draw (Westfall and Young 1993), and so pays for all that were looked at, however alike they are.

Errors far smaller than the noise that the fixes are said to have are no disagreement: they show how build tolerances
hold a fit that is looser than it need be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from calibration.gap.grammar import Grammar
from calibration.gap.neighbours import neighbours
from calibration.gap.result import Disagreement
from calibration.gap.terms import Kind
from calibration.observations import Floats

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


@dataclass(frozen=True)
class Detection:
    """What the scores say.

    Attributes:
        p: chance of such scores where nothing is missing.
        disagreements: place and variable, the most significant first, each p corrected for all that was looked at;
            what is far smaller than one in a thousand is the tail of a normal number and only ranks them.
    """

    p: float
    disagreements: tuple[Disagreement, ...]

    @property
    def significant(self) -> bool:
        """Whether something is missing."""
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
    lost = _lost(grammar)
    scores, chance = np.abs(grammar.score), np.abs(signs @ grammar.by_group) * lost
    kinds = np.array([term.kind for term in grammar.terms])
    p = np.ones(len(scores))
    for kind, share in _LARGEST.items():
        own = kinds == kind
        if own.any():
            p[own] = _of_largest(scores[own], chance[:, own].max(axis=1)) / share
    least = 0.5 ** (groups - 1)  # as often all signs agree
    p = np.clip(p, least, 1.0)
    together = max(_of_sum(float(scores @ scores), (chance**2).sum(axis=1)) / _TOGETHER, least)
    listed: dict[tuple[str, str], Disagreement] = {}
    for i in np.lexsort((-scores, p)).tolist():
        term = grammar.terms[i]
        key = term.place.where, term.variable.topic
        if p[i] < _LISTED and len(listed) < _MOST:
            listed.setdefault(key, Disagreement(*key, float(p[i])))
    alarm = min(float(p.min()), together)
    if alarm < _ALARM:
        return Detection(alarm, tuple(listed.values()))
    for along in neighbours(grammar.projection, rng, _DRAWS):  # for what no term has words for
        alike = max(_of_sum(along.shared, along.chance * lost**2) / _NEIGHBOURS, least)
        alarm = min(alarm, alike)
        if alike < _LISTED:
            listed.setdefault((along.where, along.variable), Disagreement(along.where, along.variable, alike))
    return Detection(alarm, tuple(sorted(listed.values(), key=lambda d: d.p)[:_MOST]))


def _lost(grammar: Grammar) -> float:
    """What flipped residuals have to be multiplied by.

    Residuals lack what the fit of the kinematics took out of them, along which an effect's column has nothing: its
    score is none the smaller for it, but with flipped signs the rest is spread over all directions.
    """
    kinematics = grammar.projection.rows.kinematics
    size = np.maximum(np.linalg.eigvalsh(kinematics.T @ kinematics), 0.0)
    taken = float((size / (1.0 + size)).sum())
    return 1.0 / math.sqrt(max(1.0 - taken / len(kinematics), 0.5))


def _of_largest(scores: Floats, chance: Floats) -> Floats:
    """(k,) chance that the largest score of a draw (draws,) is as large as each of the scores (k,)."""
    ordered = np.sort(chance)
    beyond = len(ordered) - np.searchsorted(ordered, scores, side="left")
    share = (beyond + 1.0) / (len(ordered) + 1.0)
    # The tail of the largest of many normal numbers is proportional to that of one.
    edge = float(log_ndtr(-ordered[-_ENOUGH]))
    tail = np.exp(np.minimum(log_ndtr(-scores) - edge, 0.0)) * (_ENOUGH + 1.0) / (len(ordered) + 1.0)
    return np.where(beyond >= _ENOUGH, share, np.minimum(tail, share))


def _of_sum(total: float, chance: Floats) -> float:
    """Chance that the sum of squares of a draw (draws,) is as large; its tail is a gamma distribution's."""
    beyond = int((chance >= total).sum())
    share = (beyond + 1.0) / (len(chance) + 1.0)
    if beyond >= _ENOUGH:
        return share
    from scipy import stats

    tail = stats.pearson3.sf(total, stats.skew(chance), chance.mean(), chance.std())
    return min(share, float(tail))
