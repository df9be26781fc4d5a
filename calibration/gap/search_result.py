"""The result of a search: the effects that close the gap, and the errors that remain when they are adopted.

Effects must close the gap that the kinematics alone leave beyond the noise, and none may be a part of something else: a
name for a part of something else is a wrong name. The noise is known from the station and the rig file only as far as
both tell the truth: sigmas are rarely right to better than a tenth.
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
from calibration.gap.criteria import beyond, explains, stands_for
from calibration.gap.detection import Detection, detect
from calibration.gap.formulas.grammar import Formula, Grammar, describe
from calibration.gap.formulas.terms import modulations
from calibration.gap.formulas.variables import ErrorSource
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projection import Projection
from calibration.gap.result import Break, Evidence
from calibration.gap.screening import ScoredEffect, Screen
from calibration.observations import Floats

_CLOSED = 0.8  # of the gap, at least
_LEFT = 0.05  # of what an effect and the remaining errors together explain, at most
_HIGH = 6.0  # standard errors of the variance that the gap must have to be judged
_MISJUDGED = 0.1  # share by which a sigma may be off
_FAR_MISJUDGED = 1.0  # the same where nothing says that it is anything but noise
COMPARED = 12  # effects that are held against a formula
_ANY_SIZE = 1e3  # of the plausible sizes of an effect
STRUCTURE = 12.0  # log Bayes factor of a background that is more than chance
_LISTED = 4  # parts of a background
_WORTH_TELLING = 0.3  # of the largest part


@dataclass(frozen=True)
class SelectionStep:
    """One step of the search.

    Attributes:
        fit: kinematics and effects at its beginning.
        projection: about that fit.
        scored: the most probable candidates, in their order.
        posterior: family -> probability that it is there.
        adopted: one effect, at one place or several; none in the last step.
        reasons: `family@where` -> why it was not named, a clause.
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
        joint: their fit.
        steps: in their order, each about the fit at that time; the last adopts nothing.
        alternatives: of the set that is pending, the most probable first; none where nothing is.
        formulas: of the grammar, where they explain the remaining errors better than all of the library.
        outside_library: of the grammar, those that beat the library after all that had been named by then, even if that
            was taken back; `formulas` by default.
        posterior: `family@where` of each adopted effect -> posterior of its family when it was adopted.
        candidates: all candidates at the beginning, and what the data lack for others.
        initial: the projection about the kinematics alone.
        final: all terms on which the remaining errors may depend.
        evidence: `family@where` of each adopted effect -> its evidence given all others.
        beside: what is certain beside a background; None where no background was needed.
        machine_break: an instant after which the machine is another; None for none.
        needs_background: True if it is known that more is left than a few formulas say.
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
    beside: Names | None = None
    machine_break: Break | None = None
    needs_background: bool = False

    @property
    def strongest_formula(self) -> tuple[Formula, ...]:
        """The formula that says most of what is left, if any does."""
        return (self.outside_library or self.final.find())[:1]

    def refitted_steps(self) -> tuple[SelectionStep, ...]:
        """Return the steps, each about a fit of what those before it adopted, without what was taken back later."""
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
    """Return the result with those effects alone that close the gap and are no part of something else.

    Args:
        problem: the data.
        joint: kinematics with all effects that were adopted.
        alone: kinematics alone.
        steps: in their order.
        alternatives: of the set that is pending.
        formulas: that explain the remaining errors better than all of the library.
        posterior: `family@where` -> posterior of its family when it was adopted.
        candidates: all candidates at the beginning.
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
    outcome = Adopted(solution, solution.fit, reason="nothing stands out of the noise that could be named")
    if joint.choices:
        outcome = adopted(solution, joint, f"the data ask for {', '.join(map(str, joint.choices))}")
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
    """True if the gap closes with the most probable of a set, which is held to what a name is held to."""
    if not alternatives:
        return False
    tried = problem.fit([*joint.choices, alternatives[0].choice], joint.fit.x)
    return _closes(problem, initial, Grammar(problem.project(tried)), is_structured=False)


def _closes(problem: Problem, initial: Projection, final: Grammar, *, is_structured: bool) -> bool:
    """`closes_gap`, detecting whether the remaining errors depend on anything unless that is known already."""
    structured = is_structured or detect(final, problem.rng()).significant
    return closes_gap(initial, final.projection, problem.solution.fit.weight, is_structured=structured)


def _without_partial_effects(
    problem: Problem, joint: JointFit, alternatives: Sequence[ScoredEffect]
) -> tuple[JointFit, dict[str, str]]:
    """Return the fit without effects that are a part of something else; `family@where` of those -> why, a clause."""
    if not joint.choices:
        return joint, {}
    # Where one of several is there, but nobody knows which, the most probable one is.
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
    """Return the steps without effects that were taken back, the first about the kinematics alone.

    Args:
        steps: in their order.
        alone: kinematics alone.
        last: the final fit.
        against: `family@where` -> why it was taken back, a clause; what was found after it by default.
    """
    kept, final = {str(c) for c in last.choices}, []
    for step in steps:
        own = tuple(c for c in step.adopted if str(c) in kept)
        dropped = {
            str(c): against.get(str(c), "what was found after it makes it superfluous")
            for c in step.adopted
            if c not in own
        }
        final.append(replace(step, adopted=own, reasons={**step.reasons, **dropped}))
    final[0] = replace(final[0], fit=alone.fit, projection=alone.projection)
    return final


def _no_effect(
    problem: Problem, steps: Sequence[SelectionStep], formulas: tuple[Formula, ...], candidates: CandidateEffects
) -> SearchResult:
    """Return a result without effects: what the library has closes a part of the gap, so it is something else."""
    reasons = {str(c): "it closes a part of the gap only" for step in steps for c in step.adopted}
    step = replace(steps[0], adopted=(), reasons={**steps[0].reasons, **reasons})
    solution, final = problem.solution, Grammar(step.projection)
    found = final.find()
    return SearchResult(
        problem,
        Adopted(solution, solution.fit, reason="what could be named closes a part of the gap only"),
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
    """True if the effects adopted between two projections close the gap, or the gap is too small to tell.

    Fixes that are no outliers to the kinematics alone are part of the gap: where it is closed for most of them and the
    others become outliers, it is not closed.

    Args:
        initial: of the kinematics alone.
        last: with all effects.
        weight: (m,) of the samples in the fit of the kinematics alone.
        is_structured: the remaining errors depend on something; if not, they may be noise far larger than assumed.
    """
    noise = last.samples.variance(last.situation.rig, last.joint_jacobian)
    misjudged = _MISJUDGED if is_structured else _FAR_MISJUDGED
    allowed = noise * ((1.0 + misjudged) ** 2 - 1.0)
    given_up = (weight >= OUTLIER) & (last.fit.weight < OUTLIER)
    outside = float((last.error_mm[given_up] ** 2).sum()) / (3.0 * len(weight))
    gap, left = initial.fit.excess_variance - allowed, last.fit.excess_variance - allowed + outside
    standard_error = (noise + allowed) * math.sqrt(2.0 / (3.0 * float(last.fit.weight.sum())))
    return gap < _HIGH * standard_error or left < (1.0 - _CLOSED) * gap + standard_error


def dependence(joint: JointFit, number: int, projection: Projection, rng: np.random.Generator) -> str:
    """Return on what the coefficient of an effect depends, though it should be a constant; empty where it is one.

    Something else was taken for the effect where the remaining errors have its pattern, but are larger in some poses or
    at some times than in others: a beam for an elastic joint, friction for play, a knock for a drift.

    Args:
        joint: kinematics and effects.
        number: of the effect.
        projection: about that fit.
        rng: draws signs, as detection does.
    """
    choice, part, own = joint.choices[number], joint.parts[number], joint.slice_of(number)
    value = joint.fit.x[own]
    # Squares that nothing else explains: those of the coefficients in their posterior, less those in their prior.
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
        detection: on what the errors still depend beyond chance.
        description: the same as a formula, and what the library has to say to it; None where there is nothing to say.
    """

    found: SearchResult
    detection: Detection
    description: str | None

    @property
    def significant(self) -> bool:
        """True if anything is there that has no name."""
        beside = self.found.beside
        is_smooth = beside is not None and beside.background_log_bayes_factor > STRUCTURE
        has_break = self.found.machine_break is not None
        return bool(
            self.detection.significant or self.found.alternatives or self.found.formulas or is_smooth or has_break
        )

    @property
    def adopted(self) -> Adopted:
        """Kinematics and effects of the search, which say whether the remaining errors are structured."""
        return replace(self.found.adopted, structured=self.significant)

    def warnings(self) -> Iterator[str]:
        """Yield sentences about effects that are there and that the model lacks, or may have at the wrong place."""
        yield from self.open_places()
        if self.found.alternatives:
            names = " or ".join(str(scored.candidate) for scored in self.found.alternatives)
            yield (
                f"the data ask for {names} and cannot tell which, so none of them is in the model; `rigcal gap` "
                f"proposes the poses that tell"
            )
        elif self.significant:
            what = "kinematics and effects" if self.found.adopted.effects else "the kinematics"
            said = f": {self.description}" if self.description else ""
            yield f"{what} leave more than noise, so the model lacks what could not be named{said}"

    def open_places(self) -> Iterator[str]:
        """Yield sentences about places that are open, and about effects that held-out groups do not bear out."""
        for name, own in self.found.evidence.items():
            others = [f"{where} ({p:.0%})" for where, p in own.places.items() if not name.endswith(f"@{where}")]
            if others:
                yield f"{name}: these data do not exclude that it is at {' or '.join(others)} instead"
        for name in self.found.beside.harmful if self.found.beside else ():
            yield f"{name} seems to be there, but raises the errors of held-out groups, so the model lacks it"


def remaining(found: SearchResult, rng: np.random.Generator) -> Remaining:
    """Test and describe the errors that a search has left.

    Args:
        found: the search.
        rng: draws the signs of detection.
    """
    final, detection = found.final, detect(found.final, rng)
    if found.machine_break is not None:
        return Remaining(found, detection, found.machine_break.text)
    if found.beside is not None and found.beside.background and not found.formulas:
        rest = Remaining(found, detection, _background_text(found.beside))
        return rest if rest.significant else replace(rest, description=None)
    formulas = found.formulas or (final.find() if detection.significant and not found.alternatives else ())
    description = describe(formulas, _library_says(found, formulas[0])) if formulas else None
    if detection.significant and not (formulas or found.alternatives or found.adopted.effects):
        on = [f"{d.variable} ({d.where})" for d in detection.disagreements[:1]] or ["something"]
        description = f"the errors depend on {on[0]} in a way that no formula of the grammar says"
    return Remaining(found, detection, description)


def _background_text(names: Names) -> str:
    """Return a clause: on what the rest depends, and the nearest effect of the library with its evidence."""
    most = names.background[0][1]
    parts = [
        f"{block.clause} ({rms_mm:.2g} mm RMS)"
        for block, rms_mm in names.background[:_LISTED]
        if rms_mm > _WORTH_TELLING * most
    ]
    is_smooth = names.background[0][0].kind not in ("event", "elastic")
    nearest = [w for w in names.left if w.log_bayes_factor > 0.0][:1]
    said = [_why_left(w, names.joint.situation) for w in nearest] or ["nothing in the library is like it"]
    return "; ".join([f"{'smooth in ' if is_smooth else ''}{', '.join(parts)}", *said])


def _why_left(scored: ScoredEffect, situation: EffectContext) -> str:
    """Return a clause: that an effect comes nearest to what is left, its evidence, and why it is not named."""
    evidence = f"log Bayes factor {scored.log_bayes_factor:.1f}"
    if names := beyond(situation, scored):
        return f"{scored.candidate} comes nearest ({evidence}), but {', '.join(names)} would be beyond what is physical"
    return f"{scored.candidate} comes nearest, with too little evidence ({evidence})"


def _library_says(found: SearchResult, formula: Formula) -> str:
    """Return a clause: which effect that was not named would do what a formula says, if any."""
    step, projection = found.steps[-1], found.final.projection
    for scored in () if found.formulas else step.scored[:COMPARED]:
        if scored.log_bayes_factor > 0.0 and explains(scored, formula, projection):
            reason = step.reasons.get(str(scored.candidate), "it does not stand out enough to be named")
            return f"{scored.candidate} would do this, but {reason}"
    for scored in Screen(projection, found.candidates.candidates).score()[:COMPARED]:
        names = beyond(projection.situation, scored)
        if names and stands_for(replace(scored, scale=_ANY_SIZE), formula, projection):
            return f"{scored.candidate} would do this, but {', '.join(names)} would be beyond what is physical"
    return "not in the library"
