"""The search for missing effects: screen, select, adopt by joint refit, and again while anything can be named."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.columns import joined
from calibration.effects.fitted import Choice
from calibration.gap.adoption import Adopted, adopted
from calibration.gap.background.blocks import displacement_blocks, possible_blocks, smooth_blocks, time_blocks
from calibration.gap.background.breaks import find_break
from calibration.gap.background.naming import Names, evidence_alone, names_beside
from calibration.gap.background.outside import formula_block, is_in_library, what_is_left
from calibration.gap.background.search import background_log_bayes_factor
from calibration.gap.candidates import CandidateEffect, CandidateEffects, candidate_effects
from calibration.gap.criteria import best_of_each_family, beyond_doubt
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem, along, joint_fit
from calibration.gap.projection import Projection, follows_path
from calibration.gap.regimes import EffectInRegime, effect_in_regime
from calibration.gap.reselection import explain_outliers, reselect
from calibration.gap.screening import ScoredEffect, Screen, by_family
from calibration.gap.search_result import COMPARED, STRUCTURE, SearchResult, SelectionStep, closes_gap, conclude
from calibration.gap.selection import Selection, select_effect
from calibration.identification.reading_steps import in_true_steps
from calibration.identification.refinement import Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Observations

_MOST_FAMILIES = 4
_STEPS = 30  # of the loop; every place of every adopted family
_FORMULAS = 3  # of effects outside the library that may explain all that is left
_REGIME = 15.0  # log Bayes factor, for an effect in a part of the data: its variable and its border are chosen
_LEAST_SAMPLES = 60  # for the evidence of a background to be more than that of a few fixes
_PENDING = 3  # sets that are adopted for the time being
_MANY = 0.02  # share of gross outliers that is more than accidents


def search(
    solution: Solution,
    observations: Observations,
    families: Collection[str],
    *,
    prior: Prior = "recalibration",
    seed: int = 0,
) -> SearchResult:
    """Find the effects that the data ask for.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        families: of effects that may be named.
        prior: of the solution.
        seed: of half-samples and folds.
    """
    seen = in_true_steps(solution, observations, prior)
    problem = Problem(seen, observations, prior, seed)
    whole = _Search(problem, families)
    found = _in_regimes(problem, families, whole.run(), whole.least_cost)
    found = _beside_background(problem, families, found)
    broken = find_break(problem, found.joint)
    if broken is not None:
        by_formulas = found.joint.fit.cost - _cost_with_formulas(problem, found)
        found = replace(found, machine_break=broken if broken.log_bayes_factor > by_formulas else None)
    if seen is solution:
        return found
    # A model counts the noise of readings as its rig file has it, and what is beyond that as scatter.
    if not found.joint.choices:
        return replace(found, adopted=Adopted(solution, solution.fit, reason=found.adopted.reason))
    joint = joint_fit(solution, observations, found.joint.choices, prior, found.joint.fit.x)
    return replace(found, adopted=adopted(solution, joint, found.adopted.reason))


class _Search:
    """A search over the given families.

    Args:
        problem: the data.
        families: of effects that may be named.
        known: an effect to begin with, which stays.

    Attributes:
        least_cost: of all fits on the way, in nats.
    """

    def __init__(self, problem: Problem, families: Collection[str], known: EffectInRegime | None = None) -> None:
        self.problem, self.families, self.known = problem, tuple(families), known
        self._initial: tuple[CandidateEffect, ...] = ()
        self.least_cost = math.inf

    def run(self) -> SearchResult:
        """Search without gross outliers, and with all samples where there are many such.

        To kinematics alone a fix that shows an effect may look like an outlier, as such fixes are often the rare ones:
        those after a step, or where a load has changed its side. The search whose effects leave fewer outliers counts.
        """
        start = self.problem.kinematics_only()
        if self.known:
            start = self.problem.fit([self.known.choice], start.fit.x)
        counted = self.problem.with_mild_outliers(start)
        weight = counted.fit.weight
        found = self._run(counted)
        if (weight < OUTLIER).mean() < _MANY:
            return found
        with_all = self._run(replace(counted, fit=replace(counted.fit, weight=np.ones_like(weight))))
        return with_all if with_all.joint.choices and self._outliers(with_all) < self._outliers(found) else found

    def _outliers(self, found: SearchResult) -> int:
        """Return the number of outliers to a result."""
        fit = found.joint.fit if found.joint.choices else self.problem.solution.fit
        return int((fit.weight < OUTLIER).sum())

    def _run(self, joint: JointFit) -> SearchResult:
        """Search from a fit of kinematics and known effects, whose weights are those of the first step."""
        first = self.problem.with_mild_outliers(self.problem.kinematics_only()) if self.known else joint
        alone = SelectionStep(first, self.problem.project(first), (), {}, ())
        initial = candidate_effects(first.situation, alone.projection, self.families)
        self._initial = initial.candidates
        steps: list[SelectionStep] = []
        posterior: dict[str, float] = {}
        projection, candidates = alone.projection, initial.candidates
        if self.known:
            choice, posterior[str(self.known.choice)] = self.known.choice, self.known.posterior
            steps.append(replace(alone, adopted=(choice,), posterior={choice.family: self.known.posterior}))
            projection, candidates = self._candidates(joint)
        pending: list[str] = []
        count, is_few = 0, True
        while True:
            selection = select_effect(self.problem, joint, projection, candidates)
            count += 1
            is_set = selection.kind == "set" and len(pending) < _PENDING
            is_last = selection.joint is None or count > _STEPS or not (is_set or selection.kind == "adopt")
            taken = () if selection.joint is None else selection.joint.choices[len(joint.choices) :]
            step = _step(joint, projection, selection, taken if selection.kind == "adopt" else ())
            reselected = self._reselected(joint, taken) if count < _STEPS else joint
            if reselected is joint and not taken and count < _STEPS:
                early = self._structured(joint, alone, [*steps, step], selection.formulas, posterior, initial)
                if early is not None:
                    return early
                # One that explains outliers as well may be better where nothing more is taken.
                reselected = explain_outliers(self.problem, joint)
            if reselected is not joint:
                joint = reselected
                projection, candidates = self._candidates(joint)
                continue
            if not is_set:
                steps.append(step)
            if is_last or selection.joint is None:
                break
            # The first of a set is adopted for the time being: others may stand out in addition to it.
            if is_set:
                pending += [str(c) for c in taken]
            posterior |= {str(c): selection.posterior[c.family] for c in taken}
            joint = selection.joint
            self.least_cost = min(self.least_cost, joint.fit.cost)
            projection, candidates = self._candidates(joint)
            was_few, is_few = is_few, len({c.family for c in joint.choices}) < _MOST_FAMILIES
            if was_few and not is_few and not self._may_explain(joint, alone, projection, candidates):
                early = self._structured(joint, alone, steps, (), posterior, initial)
                if early is not None:
                    return early
        return self._judged(joint, alone, steps, selection, posterior, pending, initial)

    def _judged(
        self,
        joint: JointFit,
        alone: SelectionStep,
        steps: list[SelectionStep],
        selection: Selection,
        posterior: dict[str, float],
        pending: Sequence[str],
        candidates: CandidateEffects,
    ) -> SearchResult:
        """Return the result of a search that has come to its end, every effect judged again given all others.

        Args:
            joint: kinematics and effects.
            alone: kinematics alone.
            steps: in their order.
            selection: the last one.
            posterior: as of `conclude`.
            pending: `family@where` of the effects that were adopted for the time being.
            candidates: all candidates at the beginning.
        """
        alternatives = selection.alternatives
        for name in pending:
            joint, judged, members = self._judged_again(joint, name)
            if judged is not None and judged.adopted:
                steps.insert(-1, judged)
                posterior |= {str(c): judged.posterior[c.family] for c in judged.adopted}
            elif judged is not None and members and not alternatives:
                steps[-1], alternatives = judged, members
        certain = [str(c) for c in joint.choices if str(c) not in pending and c.regime is None]
        joint, renamed = self._renamed(joint, certain)
        for judged in renamed:
            steps.insert(-1, judged)
            posterior |= {str(c): judged.posterior[c.family] for c in judged.adopted}
        joint = explain_outliers(self.problem, joint)
        self.least_cost = min(self.least_cost, joint.fit.cost)
        return conclude(self.problem, joint, alone, steps, alternatives, selection.formulas, posterior, candidates)

    def _may_explain(
        self,
        joint: JointFit,
        alone: SelectionStep,
        projection: Projection,
        candidates: Sequence[CandidateEffect],
    ) -> bool:
        """True if the candidates that a fit lacks, together with a few formulas, may explain what it leaves."""
        every = Screen(projection, candidates).score()
        choices = [*joint.choices, *(scored.choice for scored in every)]
        more = joined([scored.scaled_additions for scored in every], len(projection.samples))
        tried = self.problem.fit(choices, projection.solved(more))
        final, weight = Grammar(self.problem.project(tried)), self.problem.solution.fit.weight
        is_structured = detect(final, self.problem.rng()).significant
        if not closes_gap(alone.projection, final.projection, weight, is_structured=is_structured):
            return False
        return not is_structured or _formulas_suffice(self.problem, tried, final.find(1))

    def _structured(
        self,
        joint: JointFit,
        alone: SelectionStep,
        steps: Sequence[SelectionStep],
        formulas: tuple[Formula, ...],
        posterior: Mapping[str, float],
        candidates: CandidateEffects,
    ) -> SearchResult | None:
        """Return the result where more is left than effects and formulas explain, None where they may explain it all.

        Names are sought beside a background then, and which effects seemed likely without one does not matter any more.
        Arguments are those of `conclude`.
        """
        self.least_cost = min(self.least_cost, joint.fit.cost)
        if len(joint.choices) < 2:  # there is nothing to judge again
            return None
        found = conclude(self.problem, joint, alone, steps, (), formulas, posterior, candidates)
        if found.joint.choices or _formulas_suffice(self.problem, found.joint, _strongest(found)):
            return None
        return replace(found, needs_background=True)

    def _candidates(self, joint: JointFit) -> tuple[Projection, tuple[CandidateEffect, ...]]:
        """Return the projection about a fit, and the candidates that may be missing in it."""
        projection = self.problem.project_with_mild_outliers(joint)
        return projection, self._still_possible(joint.choices, projection)

    def _still_possible(self, there: Sequence[Choice], projection: Projection) -> tuple[CandidateEffect, ...]:
        """Return the candidates that may be added: of no other families once a model has its most."""
        taken = {c.family for c in there}
        allowed = [f for f in self.families if f in taken] if len(taken) >= _MOST_FAMILIES else self.families
        names = [str(c) for c in there]
        return candidate_effects(projection.situation, projection, allowed, names, self._initial).candidates

    def _reselected(self, joint: JointFit, taken: Sequence[Choice]) -> JointFit:
        """Return the fit with its effects in their best forms, before those `taken` are added.

        An effect may have a better form by now, all the more at the same place.
        """
        places = {c.where for c in taken}
        return reselect(self.problem, joint, [c for c in joint.choices if not taken or c.where in places])

    def _renamed(self, joint: JointFit, names: Sequence[str]) -> tuple[JointFit, list[SelectionStep]]:
        """Return the fit with other effects in place of those that were only the best before the others were known.

        Args:
            joint: kinematics and effects.
            names: `family@where` of the effects to judge again.
        """
        steps: list[SelectionStep] = []
        for name in names:
            if len({c.family for c in joint.choices}) == 1:
                break
            if name not in map(str, joint.choices) or self._is_plain(joint, name):
                continue
            other, step, _ = self._judged_again(joint, name)
            if step is not None and step.adopted and name not in map(str, step.adopted):
                joint = reselect(self.problem, other, other.choices)
                steps.append(step)
        return joint, steps

    def _is_plain(self, joint: JointFit, name: str) -> bool:
        """True if an effect would be named again, given all others, with no alternative near."""
        joint = joint.with_last([str(c) for c in joint.choices].index(name))
        projection = self.problem.project(joint, without_last=True)
        scored = Screen(projection, self._still_possible(joint.choices[:-1], projection)).score()
        return str(scored[0].candidate) == name and beyond_doubt(best_of_each_family(scored))

    def _judged_again(
        self, joint: JointFit, name: str
    ) -> tuple[JointFit, SelectionStep | None, tuple[ScoredEffect, ...]]:
        """Judge an effect again, now that all others are known.

        Returns:
            The fit with it or without, the step (None if the effect is not there), and the set that is not told apart.
        """
        if name not in map(str, joint.choices):
            return joint, None, ()
        others = [c for c in joint.choices if str(c) != name]
        without = self.problem.fit(others, joint.start(others))
        # What all together explain is no outlier to a part of it.
        counted = replace(without, fit=replace(without.fit, weight=joint.fit.weight))
        projection = self.problem.project_with_mild_outliers(counted)
        selection = select_effect(self.problem, without, projection, self._still_possible(others, projection))
        if selection.kind != "adopt" or selection.joint is None:
            return without, _step(without, projection, selection, ()), selection.alternatives
        taken = selection.joint.choices[len(others) :]
        return selection.joint, _step(without, projection, selection, taken), ()


def _step(joint: JointFit, projection: Projection, selection: Selection, taken: tuple[Choice, ...]) -> SelectionStep:
    # Each holds its columns, and all candidates of thousands of fixes are a good part of a gigabyte.
    scored = selection.scored[:COMPARED]
    return SelectionStep(joint, projection, scored, selection.posterior, taken, selection.reasons)


def _in_regimes(problem: Problem, families: Collection[str], found: SearchResult, least_cost: float) -> SearchResult:
    """Return a result with an effect that acts in a part of the data, where that leaves noise and is the likelier one.

    Rows in which it acts may seem to be outliers to anything else, so that all rows count where there are many such.

    Where one effect or none leaves nothing but noise, only that one may be better off in a part of the data.

    Args:
        problem: the data.
        families: of effects that may be named.
        found: with effects that act in all rows.
        least_cost: of the fits that led to it, also of those with effects that it was not sure of.
    """
    alone, like = problem.with_mild_outliers(problem.kinematics_only()), found.candidates.candidates
    if len(found.joint.choices) <= 1 and _leaves_noise(problem, found):
        one = effect_in_regime(problem, alone, [choice.family for choice in found.joint.choices], like)
        if one is None or found.joint.fit.cost - one.joint.fit.cost < _REGIME:
            return found
    starts = [alone, *([found.joint] if found.joint.choices else [])]
    if (alone.fit.weight < OUTLIER).mean() >= _MANY:
        starts.append(replace(alone, fit=replace(alone.fit, weight=np.ones_like(alone.fit.weight))))
    with_formulas: float | None = None
    for start in starts:
        one = effect_in_regime(problem, start, families, like, least_cost - _REGIME)
        if one is None or least_cost - one.joint.fit.cost < _REGIME:
            continue
        with_formulas = _cost_with_formulas(problem, found) if with_formulas is None else with_formulas
        if with_formulas - one.joint.fit.cost < _REGIME:
            continue
        if start is found.joint and detect(Grammar(problem.project(one.joint)), problem.rng()).significant:
            continue  # all others are there already
        tried = _Search(problem, families, one).run()
        if tried.joint.choices and _leaves_noise(problem, tried):
            return tried
    return found


def _cost_with_formulas(problem: Problem, found: SearchResult) -> float:
    """Return the cost of a result's effects with the formulas that explain what they leave, nats."""
    formulas = _strongest(found)
    for _ in range(_FORMULAS):
        formulas += what_is_left(problem, found.joint, formulas)
    solution, joint = problem.solution, found.joint
    columns = [formula_block(formula, number).columns for number, formula in enumerate(formulas)]
    start = np.append(joint.fit.x, np.zeros(sum(map(len, columns))))
    additions = along(solution, [*joint.parts, *columns])
    return refine(solution.chain, solution.samples, start, prior=problem.prior, additions=additions).cost


def _leaves_noise(problem: Problem, found: SearchResult) -> bool:
    """True if nothing is left that has no name."""
    is_open = found.alternatives or found.formulas or found.outside_library
    return not is_open and not detect(found.final, problem.rng()).significant


def _beside_background(problem: Problem, families: Collection[str], found: SearchResult) -> SearchResult:
    """Return a result with the effects that are beyond doubt beside structure that no library has, if there are any.

    Args:
        problem: the data.
        families: of effects that may be named.
        found: without a background; it stays as it is where it leaves nothing but noise, or nothing more is certain.
    """
    names, formulas = _names(problem, families, found)
    is_doubted = names is not None and follows_path(problem.solution.samples)
    if names is None or not (names.joint.choices or is_doubted):
        smooth = None if formulas else names
        return replace(found, evidence=evidence_alone(problem, found.joint, families), beside=smooth)
    joint, first = names.joint, found.steps[0]
    last = problem.project(joint)
    posterior = {name: own.posterior for name, own in names.evidence.items()}
    of_family = by_family(names.left) | {c.family: posterior[str(c)] for c in joint.choices}
    listed = ", ".join(map(str, joint.choices))
    reason = (
        f"the data ask for {listed}, whatever else is there" if listed else "nothing is certain beside what wanders"
    )
    return SearchResult(
        problem,
        adopted(problem.solution, joint, reason),
        joint,
        (
            replace(first, adopted=joint.choices, posterior=of_family),
            replace(first, fit=joint, projection=last, scored=names.left, posterior=of_family, adopted=(), reasons={}),
        ),
        names.open_set,
        formulas,
        formulas,
        posterior,
        found.candidates,
        found.initial,
        Grammar(last),
        names.evidence,
        names,
    )


def _names(
    problem: Problem, families: Collection[str], found: SearchResult
) -> tuple[Names | None, tuple[Formula, ...]]:
    """Return the names beside structure that no library has, None where a search has left nothing but noise.

    One effect outside the library is a formula, or two, that leave nothing; names are sought beside these, which are
    returned as well. Where formulas do not explain all that is left they may stand for anything, and names are sought
    beside a smooth unknown.
    """
    known, context, average = found.joint.choices, found.joint.situation, problem.solution.samples.average
    smooth = smooth_blocks(context, average)
    if follows_path(problem.solution.samples):
        # Errors that wander with time look like any effect whose pattern changes slowly along a path.
        wandering = [*(block for block in smooth if block.kind != "time"), *time_blocks(context, average, fine=True)]
        return names_beside(problem, wandering, families, known), ()
    final = found.final
    if found.alternatives:  # one of them is there, which explains what it explains
        tried = problem.fit([*known, found.alternatives[0].choice], found.joint.fit.x)
        final = Grammar(problem.project(tried))
    if not found.outside_library and not detect(final, problem.rng()).significant:
        if found.alternatives or len(problem.solution.samples) < _LEAST_SAMPLES:
            return None, ()
        wide = [*smooth, *displacement_blocks(context, average)]
        if background_log_bayes_factor(problem, found.joint, wide) < STRUCTURE:
            return None, ()
        names = names_beside(problem, smooth, families, known)
        left = background_log_bayes_factor(problem, names.joint, wide)
        return replace(names, background_log_bayes_factor=left), ()
    if not found.needs_background and _formulas_suffice(problem, found.joint, _strongest(found)):
        further, formulas = _strongest(found), tuple[Formula, ...]()
        for _ in range(_FORMULAS):
            formulas += tuple(f for f in further if not is_in_library(f, found.candidates.candidates, found.initial))
            names = names_beside(problem, [formula_block(f, n) for n, f in enumerate(formulas)], families, known)
            further = what_is_left(problem, names.joint, formulas)
            if not further:
                return names, formulas
    return names_beside(problem, smooth, families, known, lambda: possible_blocks(context, average)), ()


def _strongest(found: SearchResult) -> tuple[Formula, ...]:
    """Return the formula that says most of what a result leaves, if any does."""
    return (found.outside_library or found.final.find())[:1]


def _formulas_suffice(problem: Problem, joint: JointFit, formulas: tuple[Formula, ...]) -> bool:
    """True if a few formulas more explain all that effects leave, be they effects of the library in words or not."""
    for _ in range(_FORMULAS):
        further = what_is_left(problem, joint, formulas)
        if not further:
            return True
        formulas += further
    return False
