"""One step of the search: which effect to select, given those that are adopted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from calibration.effects.columns import joined
from calibration.gap.adoption import finer_forms, refined_choice
from calibration.gap.candidates import CandidateEffect
from calibration.gap.criteria import (
    NEAR,
    as_simple,
    best_of_each_family,
    beyond,
    cross_validation_p,
    further_places,
    half_sample_wins,
    is_near,
    may_stand_out,
    near_alternatives,
    odds_text,
    promising,
    stands_for,
    stands_out,
    with_finer,
    with_same_family,
)
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.formulas.terms import all_terms
from calibration.gap.formulas.variables import Variables
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.projection import Projection
from calibration.gap.screening import ScoredEffect, Screen, by_family

_MOST_OF_A_SET = 3
_CERTAIN = 0.95  # posterior of the family
_REFINED = 0.5  # of the leading log Bayes factor, for an alternative to be refined too
_ALTERNATIVES = 5  # that are compared in half-samples
_STABLE = 0.8  # of half-samples
_STABLE_AGAIN = 0.5  # the same for one more place of a family that is adopted already
_FORETOLD = 0.05  # cross-validation p
_SHARPER = 3  # times the noise is taken anew from the best hypothesis


@dataclass(frozen=True)
class Selection:
    """Outcome of one step.

    Attributes:
        kind: an effect to adopt, a set that is not told apart, a formula that beats the library, or nothing.
        scored: all candidates, the most probable first.
        posterior: family -> probability that it is there.
        joint: the fit with the selected effect, or with the most probable of a set; None without either.
        alternatives: of the set, the most probable first.
        formulas: that beat the library.
        reasons: `family@where` -> why it is not named, a clause.
    """

    kind: Literal["adopt", "set", "outside", "nothing"]
    scored: tuple[ScoredEffect, ...]
    posterior: Mapping[str, float]
    joint: JointFit | None = None
    alternatives: tuple[ScoredEffect, ...] = ()
    formulas: tuple[Formula, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)


def select_effect(
    problem: Problem, joint: JointFit, projection: Projection, candidates: Sequence[CandidateEffect]
) -> Selection:
    """Select the effect that the data ask for next.

    Args:
        problem: the data.
        joint: kinematics and effects, as adopted so far.
        projection: about that fit.
        candidates: effects that may be missing.
    """
    reasons: dict[str, str] = {}
    screen, is_further = Screen(projection, candidates), bool(joint.choices)
    while True:
        scored = screen.score(without=reasons)
        if not scored or not may_stand_out(scored):
            return Selection("nothing", scored, by_family(scored), reasons=reasons)
        sharp_screen, scored, tried = _sharpened(problem, joint, projection, promising(scored), scored[0])
        leading = scored[0]
        # Of two fits, each with its own outliers: what seemed to stand out may be the tail of a few fixes.
        evidence = joint.fit.cost - tried.fit.cost + leading.form_averaging
        if not stands_out(leading, evidence, len(candidates), is_further=is_further):
            return Selection("nothing", scored, by_family(scored), reasons=reasons)
        near = [w for w in scored if w.log_bayes_factor > leading.log_bayes_factor - 2 * NEAR]
        out = {str(w.candidate): _unphysical(names) for w in near if (names := beyond(joint.situation, w))}
        if names := tried.beyond(len(tried.choices) - 1):
            out[str(leading.candidate)] = _unphysical(names)
        reasons |= out
        if str(leading.candidate) not in out:
            break
    scored = sharp_screen.score(without=out) if out else scored
    if str(scored[0].candidate) != str(tried.choices[-1]):  # another one leads without those that are out
        start = sharp_screen.projection.solved(scored[0].scaled_additions)
        tried = problem.fit([*joint.choices, scored[0].choice], start)
    return _judged(problem, joint, sharp_screen, scored, tried, reasons)


def _unphysical(names: Sequence[str]) -> str:
    return f"{', '.join(names)} would be beyond what is physical"


def _judged(
    problem: Problem,
    joint: JointFit,
    screen: Screen,
    scored: tuple[ScoredEffect, ...],
    tried: JointFit,
    reasons: dict[str, str],
) -> Selection:
    """Judge a leading effect that stands out: alone, one of a set, or beaten by a formula.

    Args:
        problem: the data.
        joint: kinematics and effects, as adopted so far.
        screen: with the noise that the leading effect leaves.
        scored: its candidates.
        tried: the fit with the leading effect.
        reasons: why other effects are not named; completed in place.
    """
    leading, sharp, posterior = scored[0], screen.projection, by_family(scored)
    near = near_alternatives(scored)
    # A step is when those of the library are, wherever it is.
    step_times = {w.choice.settings["time_s"] for w in near if "time_s" in w.choice.settings}
    grammar = Grammar(sharp, all_terms(Variables(sharp, step_times)))
    strongest = grammar.find(1)
    most = max(scored, key=lambda w: w.log_evidence)
    # One term that explains as much as two effects together is simpler, unless both are of what is known to be there.
    known = {c.family for c in joint.choices}
    is_simple = most.partner is None or {most.candidate.family, most.partner.candidate.family} <= known
    margin = NEAR if is_simple else -NEAR
    is_beaten = bool(strongest) and strongest[0].log_evidence > most.log_evidence + margin
    if is_beaten and not any(stands_for(w, strongest[0], sharp) for w in near):
        beaten = near if most.partner is None else [*near, most, most.partner]
        reasons |= {str(w.candidate): f"{strongest[0].term} explains it better" for w in beaten}
        return Selection("outside", scored, posterior, formulas=grammar.find(), reasons=reasons)
    objection, alternatives = _objection(
        problem, sharp, scored, posterior, near, is_known=leading.candidate.family in known
    )
    if not objection:
        reasons |= {str(w.candidate): odds_text(leading, w) for w in best_of_each_family(scored)[1:]}
        more = further_places(screen, scored)
        if more:
            taken = [leading, *more]
            start = sharp.solved(joined([w.scaled_additions for w in taken], len(sharp.samples)))
            tried = problem.fit([*joint.choices, *(w.choice for w in taken)], start)
        return Selection("adopt", scored, posterior, tried, reasons=reasons)
    reasons |= {str(w.candidate): objection for w in alternatives}
    if len(alternatives) < 2:
        return Selection("nothing", scored, posterior, reasons=reasons)
    members = tuple(with_same_family(w, screen, scored) for w in alternatives[:_MOST_OF_A_SET])
    return Selection("set", scored, posterior, tried, members, reasons=reasons)


def _objection(
    problem: Problem,
    sharp: Projection,
    scored: Sequence[ScoredEffect],
    posterior: Mapping[str, float],
    near: Sequence[ScoredEffect],
    *,
    is_known: bool,
) -> tuple[str, Sequence[ScoredEffect]]:
    """Return why the leading effect is not named, a clause, empty where it is; and its set of alternatives with it.

    A family that is adopted already (`is_known`) needs less for one more place than a new family.
    """
    leading, best = scored[0], best_of_each_family(scored)
    has_equal = not is_known and any(as_simple(leading, w) for w in near[1:])
    if posterior[leading.candidate.family] < _CERTAIN or has_equal:
        return "another family is nearly as likely", near
    elsewhere = [w for w in scored[1:] if w.candidate.family == leading.candidate.family and is_near(leading, w)]
    compared = [w for w in best[1:] if w.log_bayes_factor > leading.log_bayes_factor - 6 * NEAR][:_ALTERNATIVES]
    halves = half_sample_wins(sharp, [leading, *elsewhere], compared, problem.seed)
    share = halves.get(str(leading.candidate), 0.0)
    if share < (_STABLE_AGAIN if is_known else _STABLE):
        winning = [w for name in halves for w in compared if str(w.candidate) == name]
        return f"it wins in {share:.0%} of half-samples only", [leading, *winning] if winning else near
    p = cross_validation_p(sharp, leading, problem.seed)
    return (f"it foretells errors of held-out groups no better than chance (p {p:.2g})" if p > _FORETOLD else ""), near


class _Scores(NamedTuple):
    """Candidates scored with the noise that `leading` leaves."""

    leading: ScoredEffect
    candidates: Sequence[CandidateEffect]
    screen: Screen
    scored: tuple[ScoredEffect, ...]


def _sharpened(
    problem: Problem,
    joint: JointFit,
    projection: Projection,
    candidates: Sequence[CandidateEffect],
    leading: ScoredEffect,
) -> tuple[Screen, tuple[ScoredEffect, ...], JointFit]:
    """Score all candidates with the noise that the best of them leaves, about the fit with it.

    Returns:
        The screen, its scored candidates, and the fit with the leading one.
    """
    before: _Scores | None = None
    for _ in range(_SHARPER):
        tried = problem.fit([*joint.choices, leading.choice], projection.solved(leading.scaled_additions))
        if finer_forms(tried.situation, leading.choice):
            # Which fixes are outliers depends on the form: those near a step in a wrong place look like some.
            counted = replace(tried, fit=replace(tried.fit, weight=projection.fit.weight))
            finer = refined_choice(tried.situation, leading.choice, problem.project(counted, without_last=True))
            if finer.settings != leading.choice.settings:
                tried = problem.fit([*joint.choices, finer], tried.fit.x)
                extended = with_finer(leading.candidate, leading.option, finer, projection, joint.situation)
                candidates = [extended if c is leading.candidate else c for c in candidates]
        sharp = problem.project(tried, without_last=True)
        screen = Screen(sharp, candidates)
        scored = screen.score()
        finest = [_finer(joint, sharp, candidate, scored) for candidate in candidates]
        if any(a is not b for a, b in zip(finest, candidates, strict=True)):
            candidates = finest
            screen = Screen(sharp, candidates)
            scored = screen.score()
        name = str(scored[0].candidate)
        if name == str(leading.candidate):
            break
        if before is not None and candidates is before.candidates and name == str(before.leading.candidate):
            # With the noise that either leaves the other one leads, and would for ever.
            screen, scored = before.screen, before.scored
            break
        before = _Scores(leading, candidates, screen, scored)
        leading, projection = scored[0], sharp
    best, last = scored[0].choice, tried.choices[-1]
    if (str(best), best.settings) != (str(last), last.settings):
        tried = problem.fit([*joint.choices, scored[0].choice], sharp.solved(scored[0].scaled_additions))
    return screen, scored, tried


def _finer(
    joint: JointFit, sharp: Projection, candidate: CandidateEffect, scored: Sequence[ScoredEffect]
) -> CandidateEffect:
    """Return an alternative with the finest form near its best one: no step shall lose for an instant half known."""
    own = next(w for w in scored if w.candidate is candidate)
    if own is scored[0] or own.log_bayes_factor < _REFINED * scored[0].log_bayes_factor:
        return candidate
    choice = replace(own.choice, scale=1.0)
    finer = refined_choice(joint.situation, choice, sharp)
    if finer.settings == choice.settings:
        return candidate
    return with_finer(candidate, own.option, finer, sharp, joint.situation)
