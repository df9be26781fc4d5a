"""One turn of the search: what to make of all places where an effect may be, given what is adopted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from calibration.gap.adopt import (
    JointFit,
    finer_forms,
    refined_choice,
)
from calibration.gap.decide import beyond, chance_of_foretelling, wins
from calibration.gap.grammar import Found as Formula
from calibration.gap.grammar import Grammar
from calibration.gap.problem import Problem
from calibration.gap.projection import Projection
from calibration.gap.rivals import (
    NEAR,
    as_simple,
    best_of_each_family,
    beyond_doubt,
    further_places,
    is_near,
    may_stand_out,
    near_rivals,
    odds_text,
    stands_for,
    stands_out,
    with_a_chance,
    with_finer,
    with_others_of_its_family,
)
from calibration.gap.screen import Place, Screen, Weighed, by_family
from calibration.gap.terms import candidates
from calibration.gap.variables import Variables
from calibration.identification.additions import joined

MOST_OF_A_SET = 3
_CERTAIN = 0.95  # posterior of the family
_LOOKED_AT = 0.5  # of the leading log evidence, for a rival to be looked at more closely
_RIVALS = 5  # that are looked at in half-samples
_STABLE = 0.8  # of half-samples
_STABLE_AGAIN = 0.5  # the same for one more place of a family whose name is earned already
_FORETOLD = 0.05  # p that held-out groups go with it by chance
_SHARPER = 3  # times the noise is taken anew from the best hypothesis


@dataclass(frozen=True)
class Decision:
    """What to make of all places.

    Attributes:
        kind: an effect to take, a set of several that are not told apart, a formula that beats the library, or nothing.
        weighed: all places, the most probable first.
        posterior: family -> probability that it is there.
        joint: the fit with what is taken, or with the most probable of a set; None without either.
        rivals: of the set, the most probable first.
        formulas: that beat the library.
        reasons: `family@where` -> why it is not named, a clause.
    """

    kind: Literal["take", "set", "outside", "nothing"]
    weighed: tuple[Weighed, ...]
    posterior: Mapping[str, float]
    joint: JointFit | None = None
    rivals: tuple[Weighed, ...] = ()
    formulas: tuple[Formula, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)


def decide(problem: Problem, joint: JointFit, projection: Projection, places: Sequence[Place]) -> Decision:
    """What to make of the places, given what is adopted.

    Args:
        problem: the data.
        joint: kinematics and effects, as adopted so far.
        projection: about that fit.
        places: where something may be missing.
    """
    reasons: dict[str, str] = {}
    first, is_further = Screen(projection, places), bool(joint.choices or problem.formulas)
    while True:
        weighed = first.weigh(without=reasons)
        if not weighed or not may_stand_out(weighed):
            return Decision("nothing", weighed, by_family(weighed), reasons=reasons)
        screen, weighed, tried = _sharpened(problem, joint, projection, with_a_chance(weighed), weighed[0])
        leading = weighed[0]
        # Of two fits, each with its own outliers: what seemed to stand out may be the tail of a few fixes.
        evidence = joint.fit.cost - tried.fit.cost + leading.spread
        if not stands_out(leading, evidence, len(places), beside=is_further):
            return Decision("nothing", weighed, by_family(weighed), reasons=reasons)
        near = [w for w in weighed if w.log_bayes_factor > leading.log_bayes_factor - 2 * NEAR]
        out = {
            str(w.place): f"{', '.join(names)} would be beyond what is physical"
            for w in near
            if (names := beyond(joint.situation, w))
        }
        if names := tried.beyond(len(tried.choices) - 1):
            out[str(leading.place)] = f"{', '.join(names)} would be beyond what is physical"
        reasons |= out
        if str(leading.place) not in out:
            break
    weighed = screen.weigh(without=out) if out else weighed
    if str(weighed[0].place) != str(tried.choices[-1]):  # another one leads without those that are out
        start = screen.projection.solved(weighed[0].scaled_additions)
        tried = problem.fit([*joint.choices, weighed[0].choice], start)
    return _judged(problem, joint, screen, weighed, by_family(weighed), tried, reasons)


def _judged(
    problem: Problem,
    joint: JointFit,
    screen: Screen,
    weighed: tuple[Weighed, ...],
    posterior: Mapping[str, float],
    tried: JointFit,
    reasons: dict[str, str],
) -> Decision:
    leading, sharp = weighed[0], screen.projection
    near = near_rivals(weighed)
    # A step is when those of the library are, wherever it is.
    steps = {w.choice.settings["time_s"] for w in near if "time_s" in w.choice.settings}
    grammar = Grammar(sharp, candidates(Variables(sharp, steps)))
    strongest = grammar.found(1)
    most = max(weighed, key=lambda w: w.log_evidence)
    # One term that explains as much as two effects together is simpler, unless both are of what is known to be there.
    known = {c.family for c in joint.choices}
    is_simple = most.beside is None or {most.place.family, most.beside.place.family} <= known
    margin = NEAR if is_simple else -NEAR
    is_beaten = bool(strongest) and strongest[0].log_evidence > most.log_evidence + margin
    if is_beaten and not any(stands_for(w, strongest[0], sharp) for w in near):
        beaten = near if most.beside is None else [*near, most, most.beside]
        reasons |= {str(w.place): f"{strongest[0].term} explains it better" for w in beaten}
        return Decision("outside", weighed, posterior, formulas=grammar.found(), reasons=reasons)
    against, in_place = _doubt(problem, sharp, weighed, posterior, near, is_known=leading.place.family in known)
    if not against:
        reasons |= {str(w.place): odds_text(leading, w) for w in best_of_each_family(weighed)[1:]}
        more = further_places(screen, weighed)
        if more:
            taken = [leading, *more]
            start = sharp.solved(joined([w.scaled_additions for w in taken], len(sharp.samples)))
            tried = problem.fit([*joint.choices, *(w.choice for w in taken)], start)
        return Decision("take", weighed, posterior, tried, reasons=reasons)
    reasons |= {str(w.place): against for w in in_place}
    if len(in_place) < 2 or problem.formulas:
        return Decision("nothing", weighed, posterior, reasons=reasons)
    rivals = tuple(with_others_of_its_family(w, screen, weighed) for w in in_place[:MOST_OF_A_SET])
    return Decision("set", weighed, posterior, tried, rivals, reasons=reasons)


def _doubt(
    problem: Problem,
    sharp: Projection,
    weighed: Sequence[Weighed],
    posterior: Mapping[str, float],
    near: Sequence[Weighed],
    *,
    is_known: bool,
) -> tuple[str, Sequence[Weighed]]:
    """Why the leading place is not named, a clause that is empty where it is; and it with what may be in its place.

    The name of a family that is there already (`is_known`) is earned; one more place of it needs less than a new name.
    """
    leading, best = weighed[0], best_of_each_family(weighed)
    has_equal = not is_known and any(as_simple(leading, w) for w in near[1:])
    if problem.formulas and not beyond_doubt(best):
        return "beside what is not in the library it is not beyond all doubt", near
    if any(f.term.place.where == leading.place.where for f in problem.formulas):
        return "what is not in the library is at the same place", near
    if posterior[leading.place.family] < _CERTAIN or has_equal:
        return "another family is nearly as likely", near
    elsewhere = [w for w in weighed[1:] if w.place.family == leading.place.family and is_near(leading, w)]
    rivals = [w for w in best[1:] if w.log_bayes_factor > leading.log_bayes_factor - 6 * NEAR][:_RIVALS]
    halves = wins(sharp, [leading, *elsewhere], rivals, problem.seed)
    share = halves.get(str(leading.place), 0.0)
    if share < (_STABLE_AGAIN if is_known else _STABLE):
        winning = [w for name in halves for w in rivals if str(w.place) == name]
        return f"it wins in {share:.0%} of half-samples only", [leading, *winning] if winning else near
    p = chance_of_foretelling(sharp, leading, problem.seed)
    return (f"it foretells errors of held-out groups no better than chance (p {p:.2g})" if p > _FORETOLD else ""), near


class _Round(NamedTuple):
    """Places weighed with the noise that the one that was leading leaves."""

    leading: Weighed
    places: Sequence[Place]
    screen: Screen
    weighed: tuple[Weighed, ...]


def _sharpened(
    problem: Problem, joint: JointFit, over: Projection, places: Sequence[Place], leading: Weighed
) -> tuple[Screen, tuple[Weighed, ...], JointFit]:
    """All places weighed with the noise that the best of them leaves, about the fit that has it."""
    before: _Round | None = None
    for _ in range(_SHARPER):
        tried = problem.fit([*joint.choices, leading.choice], over.solved(leading.scaled_additions))
        if finer_forms(tried.situation, leading.choice):
            # Which fixes are outliers depends on the form: those beside a step in a wrong place look like some.
            counted = replace(tried, fit=replace(tried.fit, weight=over.fit.weight))
            finer = refined_choice(tried.situation, leading.choice, problem.project(counted, without_last=True))
            if finer.settings != leading.choice.settings:
                tried = problem.fit([*joint.choices, finer], tried.fit.x)
                extended = with_finer(leading.place, leading.option, finer, over, joint.situation)
                places = [extended if p is leading.place else p for p in places]
        sharp = problem.project(tried, without_last=True)
        screen = Screen(sharp, places)
        weighed = screen.weigh()
        finer_places = [_finer(joint, sharp, place, weighed) for place in places]
        if any(a is not b for a, b in zip(finer_places, places, strict=True)):
            places = finer_places
            screen = Screen(sharp, places)
            weighed = screen.weigh()
        if str(weighed[0].place) == str(leading.place):
            break
        if before is not None and places is before.places and str(weighed[0].place) == str(before.leading.place):
            # With the noise that either leaves the other one leads, and would for ever.
            screen, weighed = before.screen, before.weighed
            break
        before = _Round(leading, places, screen, weighed)
        leading, over = weighed[0], sharp
    best, last = weighed[0].choice, tried.choices[-1]
    if (str(best), best.settings) != (str(last), last.settings):
        tried = problem.fit([*joint.choices, weighed[0].choice], sharp.solved(weighed[0].scaled_additions))
    return screen, weighed, tried


def _finer(joint: JointFit, sharp: Projection, place: Place, weighed: Sequence[Weighed]) -> Place:
    """A rival with the finest form about its best one: no step shall lose for want of a look at its instant."""
    own = next(w for w in weighed if w.place is place)
    if own is weighed[0] or own.log_bayes_factor < _LOOKED_AT * weighed[0].log_bayes_factor:
        return place
    choice = replace(own.choice, scale=1.0)
    finer = refined_choice(joint.situation, choice, sharp)
    if finer.settings == choice.settings:
        return place
    return with_finer(place, own.option, finer, sharp, joint.situation)
