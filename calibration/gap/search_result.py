"""The result of a search: the effects that close the gap, and the errors that remain when they are adopted.

Effects must close the gap, the errors of the kinematics alone beyond the noise. An effect that describes only a part of
a different cause is not named, as its name would be wrong. The noise follows from the sigmas of station and rig file,
which are rarely accurate to better than 10 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice
from calibration.gap.adoption import Adopted, adopted
from calibration.gap.background.naming import Names
from calibration.gap.candidates import CandidateEffects
from calibration.gap.criteria import beyond_limits, explains, is_equivalent
from calibration.gap.detection import Detection, detect
from calibration.gap.formulas.grammar import Formula, Grammar, describe
from calibration.gap.formulas.terms import modulations
from calibration.gap.formulas.variables import ErrorSource
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projected.projection import Projection
from calibration.gap.result import Break, Evidence
from calibration.gap.screening import ScoredEffect, Screen
from calibration.observations import Floats

_CLOSED = 0.8  # share of the gap that effects must close
_LEFT = 0.05  # a variation of the coefficient is ignored below this share of the squares of effect and variation
_HIGH = 6.0  # size of the gap, in standard errors of the variance, below which it is too small to assess
_SIGMA_ERROR = 0.1  # relative error that sigmas may have
_LARGE_SIGMA_ERROR = 1.0  # the same if the remaining errors have no structure
COMPARED = 12  # number of effects that are compared with a formula
_ANY_SIZE = 1e3  # factor on plausible sizes to allow any size
STRUCTURE = 12.0  # log Bayes factor from which on a background is significant
_LISTED = 4  # largest number of parts of a background to list
_LEAST_SHARE = 0.3  # parts below this share of the largest are not listed


@dataclass(frozen=True)
class SelectionStep:
    """One step of the search.

    Attributes:
        fit: kinematics and effects at the start of the step.
        projection: projection at that fit.
        scored: the most probable candidates, in order.
        posterior: family -> posterior probability.
        adopted: the adopted effect, at one or several places; empty in the last step.
        reasons: `family@where` -> clause that explains why it was not named.
    """

    fit: JointFit
    projection: Projection
    scored: tuple[ScoredEffect, ...]
    posterior: Mapping[str, float]
    adopted: tuple[Choice, ...]
    reasons: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SearchResult:
    """The result of the search.

    Attributes:
        problem: the data.
        adopted: kinematics and effects.
        joint: the fit of kinematics and effects.
        steps: the steps in order, each at the fit of that time; the last one adopts nothing.
        alternatives: the effects of a set that cannot be distinguished, the most probable first; empty for none.
        formulas: formulas that explain the remaining errors better than any effect of the library.
        outside_library: formulas that were better than the library given all effects adopted at that time, even if
            these were removed later; `formulas` by default.
        posterior: `family@where` of each adopted effect -> posterior of its family when it was adopted.
        candidates: all candidates at the start, and the reasons why other families are excluded.
        initial: projection at the kinematics alone.
        final: grammar of the remaining errors.
        evidence: `family@where` of each adopted effect -> its evidence given all others.
        given_background: the effects that are certain given a background; None if no background was needed.
        machine_break: an instant after which the machine is different; None for none.
        needs_background: True if a few formulas are known not to explain the remaining errors.
    """

    problem: Problem
    adopted: Adopted
    joint: JointFit
    steps: tuple[SelectionStep, ...]
    alternatives: tuple[ScoredEffect, ...]
    formulas: tuple[Formula, ...]
    outside_library: tuple[Formula, ...]
    posterior: Mapping[str, float]
    candidates: CandidateEffects
    initial: Projection
    final: Grammar
    evidence: Mapping[str, Evidence] = field(default_factory=dict)
    given_background: Names | None = None
    machine_break: Break | None = None
    needs_background: bool = False

    @property
    def strongest_formula(self) -> tuple[Formula, ...]:
        """The formula that best describes the remaining errors, or empty."""
        return (self.outside_library or self.final.find())[:1]

    def refitted_steps(self) -> tuple[SelectionStep, ...]:
        """Return the steps, each at a fit of the effects adopted before it, without effects removed later."""
        there, steps = set[str](), list[SelectionStep]()
        for step in self.steps:
            before = sorted((c for c in step.fit.choices if str(c) in there), key=str)
            like = next((own for own in steps if sorted(own.fit.choices, key=str) == before), step)
            fit, projection = like.fit, like.projection
            if len(before) < len(fit.choices):
                fit = self.problem.fit_part(fit, before)
                projection = self.problem.project(fit)
            steps.append(replace(step, fit=fit, projection=projection))
            there |= {str(c) for c in step.adopted}
        return tuple(steps)


def conclude(
    problem: Problem,
    joint: JointFit,
    alone: SelectionStep,
    steps: Sequence[SelectionStep],
    alternatives: tuple[ScoredEffect, ...],
    formulas: tuple[Formula, ...],
    posterior: Mapping[str, float],
    candidates: CandidateEffects,
) -> SearchResult:
    """Return the result with only those effects that close the gap and are not part of a different cause.

    Args:
        problem: the data.
        joint: kinematics with all adopted effects.
        alone: the step of the kinematics alone.
        steps: all steps in order.
        alternatives: effects of a set that cannot be distinguished.
        formulas: formulas that explain the remaining errors better than any effect of the library.
        posterior: `family@where` -> posterior of its family when it was adopted.
        candidates: all candidates at the start.
    """
    solution = problem.solution
    alternatives = alternatives if _may_close(problem, alone.projection, joint, alternatives) else ()
    joint, against = _without_partial_effects(problem, joint, alternatives)
    last = problem.project(joint) if joint.choices else alone.projection
    final, outside_library = Grammar(last), formulas
    if against and not alternatives:
        formulas = final.find()
    kept = _final_steps(steps, alone, joint, against)
    kept[-1] = replace(kept[-1], fit=joint, projection=last)
    initial, is_structured = kept[0].projection, bool(formulas)
    if joint.choices and not alternatives and not _closes(problem, initial, final, is_structured=is_structured):
        return _no_effect(problem, kept, outside_library or formulas, candidates)
    outcome = Adopted(solution, solution.fit, reason="no effect that could be named stands out of the noise")
    if joint.choices:
        outcome = adopted(solution, joint, f"the data require {', '.join(map(str, joint.choices))}")
    return SearchResult(
        problem,
        outcome,
        joint,
        tuple(kept),
        alternatives,
        formulas,
        outside_library or formulas,
        {str(c): posterior[str(c)] for c in joint.choices},
        candidates,
        initial,
        final,
    )


def _may_close(problem: Problem, initial: Projection, joint: JointFit, alternatives: Sequence[ScoredEffect]) -> bool:
    """Return True if the most probable effect of a set would close the gap, as required of a named effect."""
    if not alternatives:
        return False
    tried = problem.fit([*joint.choices, alternatives[0].choice], joint.fit.x)
    return _closes(problem, initial, Grammar(problem.project(tried)), is_structured=False)


def _closes(problem: Problem, initial: Projection, final: Grammar, *, is_structured: bool) -> bool:
    """Return `closes_gap`, after testing the remaining errors for structure unless it is already known."""
    structured = is_structured or detect(final, problem.rng()).significant
    return closes_gap(initial, final.projection, problem.solution.fit.weight, is_structured=structured)


def _without_partial_effects(
    problem: Problem, joint: JointFit, alternatives: Sequence[ScoredEffect]
) -> tuple[JointFit, dict[str, str]]:
    """Return the fit without effects that are part of a different cause, and `family@where` -> reason for these."""
    if not joint.choices:
        return joint, {}
    # For a set that cannot be distinguished, assume its most probable effect.
    tried = problem.fit([*joint.choices, alternatives[0].choice], joint.fit.x) if alternatives else joint
    over = problem.project(tried)
    found = {str(c): dependence(tried, n, over, problem.rng()) for n, c in enumerate(joint.choices)}
    against = {name: f"its size would depend on {text}" for name, text in found.items() if text}
    if not against:
        return joint, {}
    kept = [c for c in joint.choices if str(c) not in against]
    return problem.fit_part(joint, kept), against


def _final_steps(
    steps: Sequence[SelectionStep], alone: SelectionStep, last: JointFit, against: Mapping[str, str]
) -> list[SelectionStep]:
    """Return the steps without effects that were removed, the first one at the kinematics alone.

    Args:
        steps: all steps in order.
        alone: the step of the kinematics alone.
        last: the final fit.
        against: `family@where` -> clause with the reason of removal; by default, later effects made it superfluous.
    """
    kept, final = {str(c) for c in last.choices}, []
    for step in steps:
        own = tuple(c for c in step.adopted if str(c) in kept)
        dropped = {
            str(c): against.get(str(c), "effects found after it make it superfluous")
            for c in step.adopted
            if c not in own
        }
        final.append(replace(step, adopted=own, reasons={**step.reasons, **dropped}))
    final[0] = replace(final[0], fit=alone.fit, projection=alone.projection)
    return final


def _no_effect(
    problem: Problem, steps: Sequence[SelectionStep], formulas: tuple[Formula, ...], candidates: CandidateEffects
) -> SearchResult:
    """Return a result without effects, as library effects close only a part of the gap and so are not the cause."""
    reasons = {str(c): "it closes only a part of the gap" for step in steps for c in step.adopted}
    step = replace(steps[0], adopted=(), reasons={**steps[0].reasons, **reasons})
    solution, final = problem.solution, Grammar(step.projection)
    found = final.find()
    return SearchResult(
        problem,
        Adopted(solution, solution.fit, reason="the effects that could be named close only a part of the gap"),
        step.fit,
        (step,),
        (),
        found or formulas,
        formulas or found,
        {},
        candidates,
        step.projection,
        final,
    )


def closes_gap(initial: Projection, last: Projection, weight: Floats, *, is_structured: bool) -> bool:
    """Return True if the effects adopted between two projections close the gap, or if the gap is too small to assess.

    Fixes that are not outliers to the kinematics alone are part of the gap. If the effects make some of them outliers,
    their errors count as remaining.

    Args:
        initial: projection at the kinematics alone.
        last: projection with all effects.
        weight: (m,) weights of the samples in the fit of the kinematics alone.
        is_structured: True if the remaining errors depend on a variable; if not, they may be noise larger than assumed.
    """
    noise = last.samples.variance(last.context.rig, last.joint_jacobian)
    misjudged = _SIGMA_ERROR if is_structured else _LARGE_SIGMA_ERROR
    allowed = noise * ((1.0 + misjudged) ** 2 - 1.0)
    rejected = (weight >= OUTLIER) & (last.fit.weight < OUTLIER)
    outside = float((last.error_mm[rejected] ** 2).sum()) / (3.0 * len(weight))
    gap, left = initial.fit.excess_variance - allowed, last.fit.excess_variance - allowed + outside
    standard_error = (noise + allowed) * math.sqrt(2.0 / (3.0 * float(last.fit.weight.sum())))
    return gap < _HIGH * standard_error or left < (1.0 - _CLOSED) * gap + standard_error


def dependence(joint: JointFit, number: int, projection: Projection, rng: np.random.Generator) -> str:
    """Return the variable on which the coefficient of an effect depends; empty if it is constant, as it should be.

    If the remaining errors have the pattern of the effect, but are larger in some poses or at some times than in
    others, then a different cause was mistaken for the effect: a beam for an elastic joint, friction for play, a knock
    for a drift.

    Args:
        joint: kinematics and effects.
        number: number of the effect.
        projection: projection at that fit.
        rng: random generator for the signs of detection.
    """
    choice, part, own = joint.choices[number], joint.parts[number], joint.slice_of(number)
    value = joint.fit.x[own]
    # Squares that only this effect explains: those of the coefficients in their posterior minus those in their prior.
    explained = float(
        value @ np.linalg.solve(joint.fit.covariance[own, own], value) - ((value / part.prior_sigma) ** 2).sum()
    )
    source = ErrorSource(choice.where, str(choice), {}, projection.moved_mm(part) @ value)
    grammar = Grammar(projection, modulations(projection, source))
    left = float((grammar.score**2).max(initial=0.0))
    if left < _LEFT * (explained + left) or not detect(grammar, rng).significant:
        return ""
    return grammar.terms[int(np.abs(grammar.score).argmax())].variable.text


@dataclass(frozen=True)
class Remaining:
    """The errors that remain at the end of a search.

    Attributes:
        found: the search.
        detection: test for variables on which the errors still depend.
        description: clause with a formula or the background, and the nearest effect of the library; None for none.
    """

    found: SearchResult
    detection: Detection
    description: str | None

    @property
    def significant(self) -> bool:
        """True if there is structure without a name."""
        names = self.found.given_background
        is_smooth = names is not None and names.background_log_bayes_factor > STRUCTURE
        has_cause = self.found.machine_break is not None or self.found.adopted.structured
        return bool(
            self.detection.significant or self.found.alternatives or self.found.formulas or is_smooth or has_cause
        )

    @property
    def adopted(self) -> Adopted:
        """Kinematics and effects of the search; `structured` if the remaining errors are significant."""
        return replace(self.found.adopted, structured=self.significant)

    def warnings(self) -> Iterator[str]:
        """Yield sentences about existing effects that the model lacks, or may have at the wrong place."""
        yield from self.ambiguous_places()
        if self.found.alternatives:
            names = " or ".join(str(scored.candidate) for scored in self.found.alternatives)
            yield (
                f"the data require one of {names} but cannot distinguish them, so none is in the model; `rigcal gap` "
                f"proposes poses that distinguish them"
            )
        elif self.significant:
            what = "kinematics and effects" if self.found.adopted.effects else "the kinematics"
            suffix = f": {self.description}" if self.description else ""
            yield f"{what} leave more than noise, so the model lacks an effect that could not be named{suffix}"

    def ambiguous_places(self) -> Iterator[str]:
        """Yield sentences about ambiguous places, and about effects that held-out groups do not confirm."""
        for name, own in self.found.evidence.items():
            others = [f"{where} ({p:.0%})" for where, p in own.places.items() if not name.endswith(f"@{where}")]
            if others:
                yield f"{name}: these data do not exclude that it is at {' or '.join(others)} instead"
        for name in self.found.given_background.harmful if self.found.given_background else ():
            yield f"{name} seems to exist, but increases the errors of held-out groups, so the model lacks it"


def remaining(found: SearchResult, rng: np.random.Generator) -> Remaining:
    """Test and describe the errors that remain after a search.

    Args:
        found: result of the search.
        rng: random generator for the signs of detection.
    """
    final, detection = found.final, detect(found.final, rng)
    if found.machine_break is not None:
        return Remaining(found, detection, found.machine_break.text)
    if found.given_background is not None and found.given_background.background and not found.formulas:
        rest = Remaining(found, detection, _background_text(found.given_background))
        return rest if rest.significant else replace(rest, description=None)
    formulas = found.formulas or (final.find() if detection.significant and not found.alternatives else ())
    description = describe(formulas, _library_clause(found, formulas[0])) if formulas else None
    if detection.significant and not (formulas or found.alternatives or found.adopted.effects):
        on = [f"{d.variable} ({d.where})" for d in detection.disagreements[:1]] or ["something"]
        description = f"the errors depend on {on[0]} in a way that no formula of the grammar describes"
    return Remaining(found, detection, description)


def _background_text(names: Names) -> str:
    """Return a clause about the background: its parts, and the nearest effect of the library with its evidence."""
    most = names.background[0][1]
    parts = [
        f"{block.clause} ({rms_mm:.2g} mm RMS)"
        for block, rms_mm in names.background[:_LISTED]
        if rms_mm > _LEAST_SHARE * most
    ]
    is_smooth = names.background[0][0].kind not in ("event", "elastic")
    nearest = [w for w in names.left if w.log_bayes_factor > 0.0][:1]
    clauses = [_why_left(w, names.joint.context) for w in nearest] or ["no effect of the library is similar"]
    return "; ".join([f"{'smooth in ' if is_smooth else ''}{', '.join(parts)}", *clauses])


def _why_left(scored: ScoredEffect, context: EffectContext) -> str:
    """Return a clause about the nearest effect: its evidence, and why it is not named."""
    evidence = f"log Bayes factor {scored.log_bayes_factor:.1f}"
    if names := beyond_limits(context, scored):
        return f"{scored.candidate} is nearest ({evidence}), but {', '.join(names)} would exceed its physical limits"
    return f"{scored.candidate} is nearest, with too little evidence ({evidence})"


def _library_clause(found: SearchResult, formula: Formula) -> str:
    """Return a clause about an effect that is equivalent to a formula and why it was not named, if there is one."""
    step, projection = found.steps[-1], found.final.projection
    for scored in () if found.formulas else step.scored[:COMPARED]:
        if scored.log_bayes_factor > 0.0 and explains(scored, formula, projection):
            reason = step.reasons.get(str(scored.candidate), "it does not stand out enough to be named")
            return f"{scored.candidate} would explain this, but {reason}"
    for scored in Screen(projection, found.candidates.candidates).score()[:COMPARED]:
        names = beyond_limits(projection.context, scored)
        if names and is_equivalent(replace(scored, scale=_ANY_SIZE), formula, projection):
            return f"{scored.candidate} would explain this, but {', '.join(names)} would exceed its physical limits"
    return "not in the library"
