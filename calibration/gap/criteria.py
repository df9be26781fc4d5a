"""Criteria by which an effect is named: its evidence, its alternatives, and its stability under resampling.

The posterior alone is conditional on the library, the noise and the linear model. Half-samples and held-out groups test
the effect on the data themselves. They use data with the kinematics of the full data set projected out, as half of a
few poses would not determine the kinematics.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.candidates import CandidateEffect
from calibration.gap.formulas.grammar import Formula
from calibration.gap.projected.projection import Projection, SoftProjection, from_products, rows_of, without_folds
from calibration.gap.screening import ScoredEffect, Screen
from calibration.numerics.statistics import chance_of_mean
from calibration.observations import Floats
from calibration.residual.folds import folds

_ODDS, _FURTHER_ODDS = math.log(19.0), math.log(999.0)  # log odds required of a first effect and of a further one
_CHANCE, _FURTHER_CHANCE = 0.01, 0.003  # the same for p-values, corrected for the number of candidates
NEAR = 5.0  # difference of log Bayes factors below which families are not distinguishable
_PLAIN = 100.0  # log Bayes factor from which on an effect is certain
_EQUAL = math.log(19.0)  # log odds at which an alternative has a posterior of 0.05
_POSSIBLE = 0.02  # posterior from which on an effect is a possible alternative
_BOTH = 1.1  # sum of the posteriors of two effects from which on both are present
_RELEVANT = 0.1  # share of the leading log Bayes factor below which a candidate is irrelevant to the leading one
_COMPARED = 30  # smallest number of candidates to compare
_SAME_FAMILY = 2  # other variants and places of a family that a plan also distinguishes from other effects
_OVERWHELMING = 50.0  # log odds beyond which their size means nothing to people
_HALF_SAMPLES = 25
_FOLDS = 10


def promising(scored: Sequence[ScoredEffect]) -> list[CandidateEffect]:
    """Return the candidates that may be alternatives or additions to the leading one, as they stand out themselves."""
    order = sorted(scored, key=lambda w: -w.log_bayes_factor)
    least = _RELEVANT * scored[0].log_bayes_factor
    return [w.candidate for i, w in enumerate(order) if i < _COMPARED or w.log_bayes_factor > least or w is scored[0]]


def further_places(screen: Screen, scored: Sequence[ScoredEffect]) -> list[ScoredEffect]:
    """Return further places where the leading family is certain, given that it is at the leading place.

    Args:
        screen: products of the candidates.
        scored: the scored candidates, the leading one first.
    """
    leading, found = scored[0], list[ScoredEffect]()
    for w in sorted(scored[1:], key=lambda w: -w.log_bayes_factor):
        own = w.candidate
        if own.family != leading.candidate.family or w.log_bayes_factor < _PLAIN:
            continue
        there = [leading, *found]
        without = screen.together(there)
        gain = screen.together([*there, w]) - without
        others = [v for v in scored if v.candidate.where == own.where and v.candidate.family != own.family]
        alternative = max((screen.together([*there, v]) - without for v in others), default=-math.inf)
        if gain > max(_PLAIN, alternative + 2 * NEAR):
            found.append(w)
    return found


def has_positive_evidence(scored: Sequence[ScoredEffect]) -> bool:
    """Return True if any candidate beats the no-effect model at that model's noise."""
    return max(w.log_bayes_factor + w.candidate.log_prior for w in scored) > 0.0


def is_significant(leading: ScoredEffect, log_bayes_factor: float, tested: int, *, is_further: bool) -> bool:
    """Return True if an effect is significant, by its evidence and by the p-value of the squares it explains.

    Args:
        leading: the most probable candidate, scored with its own residual noise.
        log_bayes_factor: log Bayes factor of it against no effect, each with its own residual noise.
        tested: number of candidates.
        is_further: True if an effect is already adopted. The criteria are then stricter, as every test may raise a
            false alarm, and as an imperfect fit of an effect leaves residuals that resemble other effects.
    """
    odds, chance = (_FURTHER_ODDS, _FURTHER_CHANCE) if is_further else (_ODDS, _CHANCE)
    return log_bayes_factor + leading.candidate.log_prior > odds and leading.p * tested < chance


def is_equivalent(scored: ScoredEffect, formula: Formula, over: Projection) -> bool:
    """Return True if an effect is equivalent to a formula, even if the formula explains the data better.

    The effect must be at the same place and explain as much, possibly with more coefficients than these data require. A
    simpler error at a different place that explains more is not equivalent.

    Args:
        scored: the effect.
        formula: the formula.
        over: the projection in which they are compared.
    """
    return scored.candidate.where == formula.term.source.where and explains(scored, formula, over)


def explains(scored: ScoredEffect, formula: Formula, over: Projection) -> bool:
    """Return True if the data do not require a formula in addition to an effect.

    Args:
        scored: the effect.
        formula: the formula.
        over: the projection in which they are compared.
    """
    additions = scored.scaled_additions
    columns = over.columns(over.moved_mm(additions)) * additions.prior_sigma
    return not formula.adds_to(columns, over.residual)


def best_of_each_family(scored: Sequence[ScoredEffect]) -> list[ScoredEffect]:
    """Return the best candidate of each family, the leading one first, then by evidence."""
    found: dict[str, ScoredEffect] = {}
    for w in sorted(scored, key=lambda w: -w.log_bayes_factor):
        found.setdefault(w.candidate.family, w)
    leading = scored[0]
    return [leading, *(w for family, w in found.items() if family != leading.candidate.family)]


def near_alternatives(scored: Sequence[ScoredEffect]) -> list[ScoredEffect]:
    """Return the leading effect, and the best of each other family that could be the true effect instead."""
    found = {scored[0].candidate.family: scored[0]}
    for w in sorted(scored[1:], key=lambda w: -w.log_bayes_factor):
        if is_near(scored[0], w):
            found.setdefault(w.candidate.family, w)
    return list(found.values())


def is_near(leading: ScoredEffect, other: ScoredEffect) -> bool:
    """Return True if `other` could be the true effect instead of `leading`, rather than in addition to it."""
    near = other.log_bayes_factor > leading.log_bayes_factor - NEAR or other.posterior > _POSSIBLE
    return near and other.posterior + leading.posterior < _BOTH


def with_same_family(alternative: ScoredEffect, screen: Screen, scored: Sequence[ScoredEffect]) -> ScoredEffect:
    """Return an alternative with the other possible variants and places of its family, the most probable first.

    Args:
        alternative: one effect of a set that cannot be distinguished.
        screen: products of the candidates.
        scored: all scored candidates, the leading one first.
    """
    least = scored[0].log_bayes_factor - NEAR
    elsewhere = [w for w in scored if w.candidate.family == alternative.candidate.family and w is not alternative]
    near = [w for w in elsewhere if w.log_bayes_factor >= least and is_near(scored[0], w)]
    others = sorted([*near, *screen.forms(alternative, least)], key=lambda w: -w.log_bayes_factor)
    return replace(alternative, same_family=tuple(others[:_SAME_FAMILY]))


def is_certain(best: Sequence[ScoredEffect]) -> bool:
    """Return True if the leading effect is certain and no other family is near, by the best of each family."""
    leading, *others = (w.log_bayes_factor for w in best)
    return leading > max([_PLAIN, *(other + 2 * NEAR for other in others)])


def is_as_simple(leading: ScoredEffect, alternative: ScoredEffect) -> bool:
    """Return True if an alternative explains the data nearly as well with no more coefficients.

    Prior probabilities do not count here, neither those of places nor those of sizes. It counts that a simpler effect
    explains the data as well as the leading effect.
    """
    better = leading.log_bayes_factor - alternative.log_bayes_factor
    fits_better = leading.log_likelihood - alternative.log_likelihood
    return alternative.size <= leading.size and better < NEAR and min(better, fits_better) < _EQUAL


def with_finer(
    candidate: CandidateEffect, option: int, choice: Choice, over: Projection, context: EffectContext
) -> CandidateEffect:
    """Return a candidate with a finer variant added, at the prior odds of that variant.

    Args:
        candidate: the candidate.
        option: index of the variant that was refined.
        choice: the finer variant.
        over: the projection whose samples the columns are for.
        context: context of the observations.
    """
    choice, family = replace(choice, scale=1.0), library()[candidate.family]
    additions = choice.columns(context).over(over.samples.average)
    log_odds = math.log(family.odds(choice.settings) / family.odds(candidate.options[option].settings))
    return replace(
        candidate,
        options=(*candidate.options, choice),
        additions=(*candidate.additions, additions),
        log_odds=np.append(candidate.log_odds, candidate.log_odds[option] + log_odds),
    )


def odds_text(best: ScoredEffect, other: ScoredEffect) -> str:
    """Return a clause that states by what factor the best candidate explains the data better than another."""
    return better_text(str(best.candidate), best.log_bayes_factor - other.log_bayes_factor)


def better_text(name: str, log_odds: float) -> str:
    """Return a clause that states how much better a candidate explains the data, from the log odds."""
    if log_odds > _OVERWHELMING:
        return f"{name} explains the data overwhelmingly better"
    times = f"e^{log_odds:.0f}" if log_odds > math.log(1000.0) else f"{math.exp(max(log_odds, 0.0)):.0f}"
    return f"{name} explains the data {times} times better"


def half_sample_wins(
    projection: Projection, family: Sequence[ScoredEffect], alternatives: Sequence[ScoredEffect], seed: int
) -> dict[str, float]:
    """Return the share of half-samples, drawn by group, in which each family has the greatest evidence.

    A probable partner of the first candidate is added to each of them. The penalty for averaging over variants is split
    between both halves.

    Args:
        projection: projection at the fit.
        family: the candidate, and near candidates of its family at other places.
        alternatives: near candidates of other families; no effect is an alternative too.
        seed: random seed of the halves.

    Returns:
        `family@where` -> share, greatest first, for all candidates that win any half-sample; wins of `family` count for
        its first candidate.
    """
    scored = [*family, *alternatives]
    left = _whitened(projection, family[0], scored)
    edges = np.cumsum([0, *(len(w.additions) for w in scored)])
    labels, group = np.unique(projection.groups, return_inverse=True)
    rng = np.random.default_rng(seed)
    names = [str(family[0].candidate)] * len(family) + [str(w.candidate) for w in alternatives]
    won = Counter[str]()
    for _ in range(_HALF_SAMPLES):
        half = np.isin(group, rng.permutation(len(labels))[: (len(labels) + 1) // 2])
        rows = left[rows_of(np.flatnonzero(half))]
        values = []
        for w, (a, b) in zip(scored, itertools.pairwise(edges.tolist()), strict=True):
            own = rows[:, a:b]
            values.append(0.5 * w.form_averaging + from_products(own.T @ own, own.T @ rows[:, -1], np.ones(b - a)))
        best = int(np.argmax(values))
        if values[best] > 0.0:
            won[names[best]] += 1
    return {name: count / _HALF_SAMPLES for name, count in won.most_common()}


def cross_validation_p(projection: Projection, scored: ScoredEffect, seed: int) -> float:
    """Return the p-value of an effect's predictions of held-out groups (t-test, one-sided).

    It is not significant if a few groups have all of the evidence, as none of them is predicted by the others.

    Args:
        projection: projection at the fit.
        scored: the effect.
        seed: random seed of the folds.
    """
    left = _whitened(projection, scored, [scored])
    columns, target = left[:, :-1], left[:, -1]
    along = np.empty(len(projection.groups))
    fold = folds(projection.groups, _FOLDS, seed)
    for number, x in without_folds(columns, target, fold):
        rows = rows_of(np.flatnonzero(fold == number))
        along[fold == number] = ((columns[rows] @ x) * target[rows]).reshape(-1, 3).sum(axis=1)
    group = np.unique(projection.groups, return_inverse=True)[1]
    return chance_of_mean(np.bincount(group, along).astype(np.float64))


def beyond_limits(context: EffectContext, scored: ScoredEffect) -> tuple[str, ...]:
    """Return the names of the coefficients whose linear estimate exceeds the hard limits significantly."""
    return scored.choice.beyond_limits(context, scored.estimate, scored.standard_error)


def _whitened(projection: Projection, leading: ScoredEffect, scored: Sequence[ScoredEffect]) -> Floats:
    """Return (3 m, k + 1) columns of effects, and the target, with kinematics and the leading partner projected out."""
    columns = [_columns(projection, w) for w in scored]
    without = projection.without_kinematics
    if leading.partner is not None:
        without = SoftProjection(np.hstack([projection.kinematics, _columns(projection, leading.partner)]))
    return without(np.column_stack([*columns, projection.target]))


def _columns(projection: Projection, scored: ScoredEffect) -> Floats:
    """Return (3 m, k) whitened columns, in prior sigmas."""
    whitened = projection.whitened(projection.moved_mm(scored.additions))
    return whitened * (scored.additions.prior_sigma * scored.scale)
