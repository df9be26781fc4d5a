"""What else may be in the place of the most probable effect, and what is there beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.grammar import Found as Formula
from calibration.gap.projection import Projection
from calibration.gap.screen import Place, Screen, Weighed

_ODDS, _FURTHER_ODDS = math.log(19.0), math.log(999.0)  # that something is there, and something more beside that
_CHANCE, _FURTHER_CHANCE = 0.01, 0.003  # of anything at all, corrected for all that was looked at, and of more
NEAR = 5.0  # in log evidence: families this near are not told apart
_PLAIN = 100.0  # log evidence beyond any doubt
_AS_WELL = math.log(19.0)  # log odds at which a rival has a posterior of 0.05
_POSSIBLE = 0.02  # posterior of a rival
_BOTH = 1.1  # posterior of two places together that cannot each be in place of the other
_BESIDE = 0.1  # of the leading log evidence: less is neither like it nor seen beside it
_COMPARED = 30  # places at least
_INSTEAD = 2  # of a family, that a plan tells from the others as well


def with_a_chance(weighed: Sequence[Weighed]) -> list[Place]:
    """The places that may matter to the leading one: what is like it, or beside it, stands out as well."""
    order = sorted(weighed, key=lambda w: -w.log_bayes_factor)
    least = _BESIDE * weighed[0].log_bayes_factor
    return [w.place for i, w in enumerate(order) if i < _COMPARED or w.log_bayes_factor > least or w is weighed[0]]


def further_places(screen: Screen, weighed: Sequence[Weighed]) -> list[Weighed]:
    """Where the leading family is as well beyond any doubt, given that it is at the leading place."""
    leading, found = weighed[0], list[Weighed]()
    for w in sorted(weighed[1:], key=lambda w: -w.log_bayes_factor):
        if w.place.family != leading.place.family or w.log_bayes_factor < _PLAIN:
            continue
        there = [leading, *found]
        gain = screen.together([*there, w]) - screen.together(there)
        others = [v for v in weighed if v.place.where == w.place.where and v.place.family != w.place.family]
        rival = max((screen.together([*there, v]) - screen.together(there) for v in others), default=-math.inf)
        if gain > max(_PLAIN, rival + 2 * NEAR):
            found.append(w)
    return found


def together(screen: Screen, chosen: Mapping[int, tuple[int, float]]) -> float:
    """Log evidence of several places (number: variant, scale) together; none at all is 0."""
    if not chosen:
        return 0.0
    options = [(number, option) for number, (option, _) in chosen.items()]
    return screen.log_bayes_factor(options, [scale for _, scale in chosen.values()])


def may_stand_out(weighed: Sequence[Weighed]) -> bool:
    """Whether any place is more likely than nothing, with the noise that nothing leaves."""
    return max(w.log_bayes_factor + w.place.log_prior for w in weighed) > 0.0


def stands_out(leading: Weighed, evidence: float, looks: int, *, beside: bool) -> bool:
    """Whether anything is there: by its evidence, and by the chance of what it explains.

    Args:
        leading: the most probable place, with the noise that it leaves.
        evidence: log evidence of it against nothing, each with the noise that it leaves.
        looks: how many places were looked at.
        beside: whether something is adopted already: every further look is another chance, and what does not quite fit
            leaves traces that look like other effects.
    """
    odds, chance = (_FURTHER_ODDS, _FURTHER_CHANCE) if beside else (_ODDS, _CHANCE)
    return evidence + leading.place.log_prior > odds and leading.p * looks < chance


def stands_for(weighed: Weighed, formula: Formula, over: Projection) -> bool:
    """Whether an effect does what a formula says, though the formula explains the data better.

    It may explain as much with more coefficients than these data ask for, at the same place: an error of another place
    that is simpler and explains more is something else.
    """
    return weighed.place.where == formula.term.place.where and explains(weighed, formula, over)


def explains(weighed: Weighed, formula: Formula, over: Projection) -> bool:
    """Whether the data ask for nothing of a formula beside an effect."""
    additions = weighed.scaled_additions
    columns = over.columns(over.moved_mm(additions)) * additions.prior_sigma
    return not formula.shows_beside(columns, over.residual)


def best_of_each_family(weighed: Sequence[Weighed]) -> list[Weighed]:
    """The best place of each family, the leading one first, then by evidence."""
    found: dict[str, Weighed] = {}
    for w in sorted(weighed, key=lambda w: -w.log_bayes_factor):
        found.setdefault(w.place.family, w)
    leading = weighed[0]
    return [leading, *(w for family, w in found.items() if family != leading.place.family)]


def near_rivals(weighed: Sequence[Weighed]) -> list[Weighed]:
    """The leading place, and the best of each other family that may be there in its place: none that is beside it."""
    found = {weighed[0].place.family: weighed[0]}
    for w in sorted(weighed[1:], key=lambda w: -w.log_bayes_factor):
        if is_near(weighed[0], w):
            found.setdefault(w.place.family, w)
    return list(found.values())


def is_near(leading: Weighed, other: Weighed) -> bool:
    """Whether another place may be what it is in place of the leading one."""
    near = other.log_bayes_factor > leading.log_bayes_factor - NEAR or other.posterior > _POSSIBLE
    return near and other.posterior + leading.posterior < _BOTH


def with_others_of_its_family(rival: Weighed, screen: Screen, weighed: Sequence[Weighed]) -> Weighed:
    """One of a set, with the other forms and places of its family that may be what it is, the most probable first."""
    least = weighed[0].log_bayes_factor - NEAR
    elsewhere = [w for w in weighed if w.place.family == rival.place.family and w is not rival]
    near = [w for w in elsewhere if w.log_bayes_factor >= least and is_near(weighed[0], w)]
    others = sorted([*near, *screen.forms(rival, least)], key=lambda w: -w.log_bayes_factor)
    return replace(rival, instead=tuple(others[:_INSTEAD]))


def beyond_doubt(best: Sequence[Weighed]) -> bool:
    """Whether the leading place is plain to see and no other family comes near, by the best of each family."""
    leading, *others = (w.log_bayes_factor for w in best)
    return leading > max([_PLAIN, *(other + 2 * NEAR for other in others)])


def as_simple(leading: Weighed, rival: Weighed) -> bool:
    """Whether a rival explains the data nearly as well with no more coefficients.

    What is likelier beforehand is no evidence, neither by the number of its places nor by the size that it asks for.
    That something simpler explains as much as a part of it is.
    """
    better = leading.log_bayes_factor - rival.log_bayes_factor
    fits_better = leading.log_likelihood - rival.log_likelihood
    return rival.size <= leading.size and better < NEAR and min(better, fits_better) < _AS_WELL


def with_finer(place: Place, option: int, choice: Choice, over: Projection, situation: Situation) -> Place:
    """A place with a finer form of one of its variants more, by its own odds beside that one."""
    choice, family = replace(choice, scale=1.0), library()[place.family]
    additions = choice.additions(situation).over(over.samples.average)
    beside = math.log(family.odds(choice.settings) / family.odds(place.options[option].settings))
    odds = np.append(place.log_odds, place.log_odds[option] + beside)
    return replace(place, options=(*place.options, choice), additions=(*place.additions, additions), log_odds=odds)


def odds_text(best: Weighed, other: Weighed) -> str:
    """How much better the best explains the data than another, a clause."""
    return f"{best.place} explains the data {_times(best.log_bayes_factor - other.log_bayes_factor)} better"


def _times(log_odds: float) -> str:
    return f"e^{log_odds:.0f} times" if log_odds > math.log(1000.0) else f"{math.exp(max(log_odds, 0.0)):.0f} times"
