"""One step of the search: the selection of an effect, given the adopted ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from calibration.effects.columns import joined
from calibration.gap.adoption import finer_forms, refined_choice
from calibration.gap.candidates import CandidateEffect
from calibration.gap.criteria import (
    NEAR,
    best_of_each_family,
    beyond_limits,
    cross_validation_p,
    further_places,
    half_sample_wins,
    has_positive_evidence,
    is_as_simple,
    is_equivalent,
    is_near,
    is_significant,
    near_alternatives,
    odds_text,
    promising,
    with_finer,
    with_same_family,
)
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.formulas.terms import all_terms
from calibration.gap.formulas.variables import Variables
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import ScoredEffect, Screen, by_family

_MOST_OF_A_SET = 3
_CERTAIN = 0.95  # required posterior of the family
_REFINED = 0.5  # share of the leading log Bayes factor from which on an alternative is refined too
_ALTERNATIVES = 5  # largest number of alternatives compared in half-samples
_STABLE = 0.8  # share of half-samples that an effect must win
_STABLE_AGAIN = 0.5  # the same for a further place of an adopted family
_MOST_P = 0.05  # largest p-value of the cross-validation
_ROUNDS = 3  # largest number of rounds of updating the noise by the best hypothesis


@dataclass(frozen=True)
class Selection:
    """Outcome of one step.

    Attributes:
        kind: an effect to adopt, a set that cannot be distinguished, a formula that beats the library, or nothing.
        scored: all candidates, the most probable first.
        posterior: family -> posterior probability.
        joint: the fit with the selected effect, or with the most probable of a set; None without either.
        alternatives: the effects of the set, the most probable first.
        formulas: the formulas that beat the library.
        reasons: `family@where` -> clause that explains why it is not named.
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
    """Select the next effect that the data require.

    Args:
        problem: the data.
        joint: kinematics and the effects adopted so far.
        projection: projection at that fit.
        candidates: effects that may be missing.
    """
    reasons: dict[str, str] = {}
    screen, is_further = Screen(projection, candidates), bool(joint.choices)
    while True:
        scored = screen.score(without=reasons)
        if not scored or not has_positive_evidence(scored):
            return Selection("nothing", scored, by_family(scored), reasons=reasons)
        best_screen, scored, tried = _scored_at_best_noise(problem, joint, projection, promising(scored), scored[0])
        leading = scored[0]
        # Compare two fits, each with its own outliers, as apparent evidence may come from a few outlying fixes.
        evidence = joint.fit.cost - tried.fit.cost + leading.form_averaging
        if not is_significant(leading, evidence, len(candidates), is_further=is_further):
            return Selection("nothing", scored, by_family(scored), reasons=reasons)
        near = [w for w in scored if w.log_bayes_factor > leading.log_bayes_factor - 2 * NEAR]
        out = {str(w.candidate): _unphysical(names) for w in near if (names := beyond_limits(joint.context, w))}
        if names := tried.beyond_limits(len(tried.choices) - 1):
            out[str(leading.candidate)] = _unphysical(names)
        reasons |= out
        if str(leading.candidate) not in out:
            break
    scored = best_screen.score(without=out) if out else scored
    if str(scored[0].candidate) != str(tried.choices[-1]):  # a different effect leads after the exclusions
        start = best_screen.projection.solved(scored[0].scaled_additions)
        tried = problem.fit([*joint.choices, scored[0].choice], start)
    return _decide(problem, joint, best_screen, scored, tried, reasons)


def _unphysical(names: Sequence[str]) -> str:
    return f"{', '.join(names)} would exceed its physical limits"


def _decide(
    problem: Problem,
    joint: JointFit,
    screen: Screen,
    scored: tuple[ScoredEffect, ...],
    tried: JointFit,
    reasons: dict[str, str],
) -> Selection:
    """Decide whether a leading effect is adopted, is one of a set, or is beaten by a formula.

    Args:
        problem: the data.
        joint: kinematics and the effects adopted so far.
        screen: screen at the noise that the leading effect leaves.
        scored: candidates of the screen.
        tried: the fit with the leading effect.
        reasons: `family@where` -> why it is not named; extended in place.
    """
    leading, best_projection, posterior = scored[0], screen.projection, by_family(scored)
    near = near_alternatives(scored)
    # Formulas may have steps at the same instants as the step effects.
    step_times = {w.choice.settings["time_s"] for w in near if "time_s" in w.choice.settings}
    grammar = Grammar(best_projection, all_terms(Variables(best_projection, step_times)))
    strongest = grammar.find(1)
    most = max(scored, key=lambda w: w.log_evidence)
    # A single term that explains as much as two effects is simpler, unless both are of families already adopted.
    known = {c.family for c in joint.choices}
    is_simple = most.partner is None or {most.candidate.family, most.partner.candidate.family} <= known
    margin = NEAR if is_simple else -NEAR
    is_beaten = bool(strongest) and strongest[0].log_evidence > most.log_evidence + margin
    if is_beaten and not any(is_equivalent(w, strongest[0], best_projection) for w in near):
        beaten = near if most.partner is None else [*near, most, most.partner]
        reasons |= {str(w.candidate): f"{strongest[0].term} explains it better" for w in beaten}
        return Selection("outside", scored, posterior, formulas=grammar.find(), reasons=reasons)
    objection, alternatives = _objection(
        problem, best_projection, scored, posterior, near, is_known=leading.candidate.family in known
    )
    if not objection:
        reasons |= {str(w.candidate): odds_text(leading, w) for w in best_of_each_family(scored)[1:]}
        more = further_places(screen, scored)
        if more:
            taken = [leading, *more]
            start = best_projection.solved(joined([w.scaled_additions for w in taken], len(best_projection.samples)))
            tried = problem.fit([*joint.choices, *(w.choice for w in taken)], start)
        return Selection("adopt", scored, posterior, tried, reasons=reasons)
    reasons |= {str(w.candidate): objection for w in alternatives}
    if len(alternatives) < 2:
        return Selection("nothing", scored, posterior, reasons=reasons)
    members = tuple(with_same_family(w, screen, scored) for w in alternatives[:_MOST_OF_A_SET])
    return Selection("set", scored, posterior, tried, members, reasons=reasons)


def _objection(
    problem: Problem,
    best_projection: Projection,
    scored: Sequence[ScoredEffect],
    posterior: Mapping[str, float],
    near: Sequence[ScoredEffect],
    *,
    is_known: bool,
) -> tuple[str, Sequence[ScoredEffect]]:
    """Return a clause that explains why the leading effect is not named, or empty, and the set of its alternatives.

    For a further place of an adopted family (`is_known`), less is required than for a new family.
    """
    leading, best = scored[0], best_of_each_family(scored)
    has_equal = not is_known and any(is_as_simple(leading, w) for w in near[1:])
    if posterior[leading.candidate.family] < _CERTAIN or has_equal:
        return "a different family is nearly as probable", near
    elsewhere = [w for w in scored[1:] if w.candidate.family == leading.candidate.family and is_near(leading, w)]
    compared = [w for w in best[1:] if w.log_bayes_factor > leading.log_bayes_factor - 6 * NEAR][:_ALTERNATIVES]
    halves = half_sample_wins(best_projection, [leading, *elsewhere], compared, problem.seed)
    share = halves.get(str(leading.candidate), 0.0)
    if share < (_STABLE_AGAIN if is_known else _STABLE):
        winning = [w for name in halves for w in compared if str(w.candidate) == name]
        return f"it wins in only {share:.0%} of half-samples", [leading, *winning] if winning else near
    p = cross_validation_p(best_projection, leading, problem.seed)
    return (f"it predicts errors of held-out groups no better than chance (p {p:.2g})" if p > _MOST_P else ""), near


class _Scores(NamedTuple):
    """Candidates scored at the noise that `leading` leaves."""

    leading: ScoredEffect
    candidates: Sequence[CandidateEffect]
    screen: Screen
    scored: tuple[ScoredEffect, ...]


def _scored_at_best_noise(
    problem: Problem,
    joint: JointFit,
    projection: Projection,
    candidates: Sequence[CandidateEffect],
    leading: ScoredEffect,
) -> tuple[Screen, tuple[ScoredEffect, ...], JointFit]:
    """Score all candidates at the noise that the best of them leaves, linearised at the fit with it.

    Returns:
        The screen, its scored candidates, and the fit with the leading one.
    """
    before: _Scores | None = None
    for _ in range(_ROUNDS):
        tried = problem.fit([*joint.choices, leading.choice], projection.solved(leading.scaled_additions))
        if finer_forms(tried.context, leading.choice):
            # Outliers depend on the variant: fixes near a step at a wrong instant look like outliers.
            counted = replace(tried, fit=replace(tried.fit, weight=projection.fit.weight))
            finer = refined_choice(tried.context, leading.choice, problem.project(counted, without_last=True))
            if finer.settings != leading.choice.settings:
                tried = problem.fit([*joint.choices, finer], tried.fit.x)
                extended = with_finer(leading.candidate, leading.option, finer, projection, joint.context)
                candidates = [extended if c is leading.candidate else c for c in candidates]
        best_projection = problem.project(tried, without_last=True)
        screen = Screen(best_projection, candidates)
        scored = screen.score()
        finest = [_finer(joint, best_projection, candidate, scored) for candidate in candidates]
        if any(a is not b for a, b in zip(finest, candidates, strict=True)):
            candidates = finest
            screen = Screen(best_projection, candidates)
            scored = screen.score()
        name = str(scored[0].candidate)
        if name == str(leading.candidate):
            break
        if before is not None and candidates is before.candidates and name == str(before.leading.candidate):
            # Two effects lead alternately, each at the noise of the other, so stop.
            screen, scored = before.screen, before.scored
            break
        before = _Scores(leading, candidates, screen, scored)
        leading, projection = scored[0], best_projection
    best, last = scored[0].choice, tried.choices[-1]
    if (str(best), best.settings) != (str(last), last.settings):
        tried = problem.fit([*joint.choices, scored[0].choice], best_projection.solved(scored[0].scaled_additions))
    return screen, scored, tried


def _finer(
    joint: JointFit, best_projection: Projection, candidate: CandidateEffect, scored: Sequence[ScoredEffect]
) -> CandidateEffect:
    """Return an alternative with a refined variant added, so that a step does not lose because of a coarse instant."""
    own = next(w for w in scored if w.candidate is candidate)
    if own is scored[0] or own.log_bayes_factor < _REFINED * scored[0].log_bayes_factor:
        return candidate
    choice = replace(own.choice, scale=1.0)
    finer = refined_choice(joint.context, choice, best_projection)
    if finer.settings == choice.settings:
        return candidate
    return with_finer(candidate, own.option, finer, best_projection, joint.context)
