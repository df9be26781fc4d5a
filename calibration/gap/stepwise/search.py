"""Stepwise search for missing effects: screen, select and adopt by joint refit, as long as an effect can be named."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.columns import joined
from calibration.effects.fitted import Choice
from calibration.gap.background.outside import formulas_suffice
from calibration.gap.candidates import CandidateEffect, CandidateEffects, candidate_effects
from calibration.gap.criteria import best_of_each_family, is_certain
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projected.projection import Projection
from calibration.gap.regimes import EffectInRegime
from calibration.gap.screening import ScoredEffect, Screen
from calibration.gap.search_result import COMPARED, SearchResult, SelectionStep, closes_gap, conclude
from calibration.gap.stepwise.reselection import explain_outliers, reselect
from calibration.gap.stepwise.selection import Selection, select_effect

_MOST_FAMILIES = 4
_STEPS = 30  # largest number of iterations, enough for every place of every adopted family
_PENDING = 3  # largest number of sets that are adopted provisionally
MANY_OUTLIERS = 0.02  # share of gross outliers from which on they may not be accidental


class StepwiseSearch:
    """A search over the given families.

    Args:
        problem: the data.
        families: families of effects that may be named.
        known: an initial effect, which is kept.

    Attributes:
        least_cost: smallest cost of all fits so far, nats.
    """

    def __init__(self, problem: Problem, families: Collection[str], known: EffectInRegime | None = None) -> None:
        self.problem, self.families, self.known = problem, tuple(families), known
        self._initial: tuple[CandidateEffect, ...] = ()
        self.least_cost = math.inf

    def run(self) -> SearchResult:
        """Search without gross outliers, and if there are many, again with all samples.

        Without the effect, fixes that reveal it may look like outliers, as such fixes are often rare: those after a
        step, or where a load has changed its sign. The search whose effects leave fewer outliers is returned.
        """
        start = self.problem.kinematics_only()
        if self.known:
            start = self.problem.fit([self.known.choice], start.fit.x)
        counted = self.problem.with_mild_outliers(start)
        weight = counted.fit.weight
        found = self._run(counted)
        if (weight < OUTLIER).mean() < MANY_OUTLIERS:
            return found
        with_all = self._run(replace(counted, fit=replace(counted.fit, weight=np.ones_like(weight))))
        return with_all if with_all.joint.choices and self._outliers(with_all) < self._outliers(found) else found

    def _outliers(self, found: SearchResult) -> int:
        """Return the number of outliers of a result."""
        fit = found.joint.fit if found.joint.choices else self.problem.solution.fit
        return int((fit.weight < OUTLIER).sum())

    def _run(self, joint: JointFit) -> SearchResult:
        """Search from a fit of kinematics and known effects, with the weights of this fit in the first step."""
        first = self.problem.with_mild_outliers(self.problem.kinematics_only()) if self.known else joint
        alone = SelectionStep(first, self.problem.project(first), (), {}, ())
        initial = candidate_effects(first.context, alone.projection, self.families)
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
                # If no effect is added, variants that also explain the outliers may be better.
                reselected = explain_outliers(self.problem, joint)
            if reselected is not joint:
                joint = reselected
                projection, candidates = self._candidates(joint)
                continue
            if not is_set:
                steps.append(step)
            if is_last or selection.joint is None:
                break
            # The first effect of a set is adopted provisionally, as further effects may stand out given it.
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
        return self._conclude(joint, alone, steps, selection, posterior, pending, initial)

    def _conclude(
        self,
        joint: JointFit,
        alone: SelectionStep,
        steps: list[SelectionStep],
        selection: Selection,
        posterior: dict[str, float],
        pending: Sequence[str],
        candidates: CandidateEffects,
    ) -> SearchResult:
        """Return the final result of a search, with every effect assessed again given all others.

        Args:
            joint: kinematics and effects.
            alone: the step of the kinematics alone.
            steps: all steps in order.
            selection: the last selection.
            posterior: as for `conclude`.
            pending: `family@where` of the provisionally adopted effects.
            candidates: all candidates at the start.
        """
        alternatives = selection.alternatives
        for name in pending:
            joint, reassessed, members = self._reassessed(joint, name)
            if reassessed is not None and reassessed.adopted:
                steps.insert(-1, reassessed)
                posterior |= {str(c): reassessed.posterior[c.family] for c in reassessed.adopted}
            elif reassessed is not None and members and not alternatives:
                steps[-1], alternatives = reassessed, members
        certain = [str(c) for c in joint.choices if str(c) not in pending and c.regime is None]
        joint, renamed = self._renamed(joint, certain)
        for reassessed in renamed:
            steps.insert(-1, reassessed)
            posterior |= {str(c): reassessed.posterior[c.family] for c in reassessed.adopted}
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
        """Return True if the candidates missing in a fit, with a few formulas, may explain its residuals."""
        every = Screen(projection, candidates).score()
        choices = [*joint.choices, *(scored.choice for scored in every)]
        more = joined([scored.scaled_additions for scored in every], len(projection.samples))
        tried = self.problem.fit(choices, projection.solved(more))
        final, weight = Grammar(self.problem.project(tried)), self.problem.solution.fit.weight
        is_structured = detect(final, self.problem.rng()).significant
        if not closes_gap(alone.projection, final.projection, weight, is_structured=is_structured):
            return False
        return not is_structured or formulas_suffice(self.problem, tried, final.find(1))

    def _structured(
        self,
        joint: JointFit,
        alone: SelectionStep,
        steps: Sequence[SelectionStep],
        formulas: tuple[Formula, ...],
        posterior: Mapping[str, float],
        candidates: CandidateEffects,
    ) -> SearchResult | None:
        """Return a result that needs a background, or None if effects and formulas may explain all residuals.

        With such a result the stepwise search can end early, as all effects are assessed again given a background.
        Arguments are those of `conclude`.
        """
        self.least_cost = min(self.least_cost, joint.fit.cost)
        if len(joint.choices) < 2:  # there is nothing to reassess
            return None
        found = conclude(self.problem, joint, alone, steps, (), formulas, posterior, candidates)
        if found.joint.choices or formulas_suffice(self.problem, found.joint, found.strongest_formula):
            return None
        return replace(found, needs_background=True)

    def _candidates(self, joint: JointFit) -> tuple[Projection, tuple[CandidateEffect, ...]]:
        """Return the projection at a fit, and the candidates that may be missing in it."""
        projection = self.problem.project_with_mild_outliers(joint)
        return projection, self._still_possible(joint.choices, projection)

    def _still_possible(self, there: Sequence[Choice], projection: Projection) -> tuple[CandidateEffect, ...]:
        """Return the candidates that may be added; no new families once a model has the largest number of families."""
        taken = {c.family for c in there}
        allowed = [f for f in self.families if f in taken] if len(taken) >= _MOST_FAMILIES else self.families
        names = [str(c) for c in there]
        return candidate_effects(projection.context, projection, allowed, names, self._initial).candidates

    def _reselected(self, joint: JointFit, taken: Sequence[Choice]) -> JointFit:
        """Return the fit with its effects in their best variants, before the effects `taken` are added.

        If effects are added, only effects at the same places are reselected.
        """
        places = {c.where for c in taken}
        return reselect(self.problem, joint, [c for c in joint.choices if not taken or c.where in places])

    def _renamed(self, joint: JointFit, names: Sequence[str]) -> tuple[JointFit, list[SelectionStep]]:
        """Return the fit after replacing effects that are no longer the best given all others, and the steps for it.

        Args:
            joint: kinematics and effects.
            names: `family@where` of the effects to assess again.
        """
        steps: list[SelectionStep] = []
        for name in names:
            if len({c.family for c in joint.choices}) == 1:
                break
            if name not in map(str, joint.choices) or self._is_certain(joint, name):
                continue
            other, step, _ = self._reassessed(joint, name)
            if step is not None and step.adopted and name not in map(str, step.adopted):
                joint = reselect(self.problem, other, other.choices)
                steps.append(step)
        return joint, steps

    def _is_certain(self, joint: JointFit, name: str) -> bool:
        """Return True if an effect would be named again given all others, without a near alternative."""
        joint = joint.with_last([str(c) for c in joint.choices].index(name))
        projection = self.problem.project(joint, without_last=True)
        scored = Screen(projection, self._still_possible(joint.choices[:-1], projection)).score()
        return str(scored[0].candidate) == name and is_certain(best_of_each_family(scored))

    def _reassessed(
        self, joint: JointFit, name: str
    ) -> tuple[JointFit, SelectionStep | None, tuple[ScoredEffect, ...]]:
        """Assess an effect again given all others.

        Returns:
            The fit with the effect or without it, the step (None if the fit lacks the effect), and the set of effects
            that cannot be distinguished.
        """
        if name not in map(str, joint.choices):
            return joint, None, ()
        others = [c for c in joint.choices if str(c) != name]
        without = self.problem.fit_part(joint, others)
        # Use the weights of the full fit, as samples that all effects together explain are not outliers.
        counted = replace(without, fit=replace(without.fit, weight=joint.fit.weight))
        projection = self.problem.project_with_mild_outliers(counted)
        selection = select_effect(self.problem, without, projection, self._still_possible(others, projection))
        if selection.kind != "adopt" or selection.joint is None:
            return without, _step(without, projection, selection, ()), selection.alternatives
        taken = selection.joint.choices[len(others) :]
        return selection.joint, _step(without, projection, selection, taken), ()


def _step(joint: JointFit, projection: Projection, selection: Selection, taken: tuple[Choice, ...]) -> SelectionStep:
    # Keep only some candidates, as their columns for thousands of fixes take a large part of a gigabyte.
    scored = selection.scored[:COMPARED]
    return SelectionStep(joint, projection, scored, selection.posterior, taken, selection.reasons)
