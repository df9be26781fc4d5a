"""One search for missing effects, step by step: screen, select, adopt by joint refit, while anything can be named."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.columns import joined
from calibration.effects.fitted import Choice
from calibration.gap.background.outside import formulas_suffice
from calibration.gap.candidates import CandidateEffect, CandidateEffects, candidate_effects
from calibration.gap.criteria import best_of_each_family, beyond_doubt
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projection import Projection
from calibration.gap.regimes import EffectInRegime
from calibration.gap.screening import ScoredEffect, Screen
from calibration.gap.search_result import COMPARED, SearchResult, SelectionStep, closes_gap, conclude
from calibration.gap.stepwise.reselection import explain_outliers, reselect
from calibration.gap.stepwise.selection import Selection, select_effect

_MOST_FAMILIES = 4
_STEPS = 30  # of the loop; every place of every adopted family
_PENDING = 3  # sets that are adopted for the time being
MANY_OUTLIERS = 0.02  # share of gross outliers that is more than accidents


class StepwiseSearch:
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
        if (weight < OUTLIER).mean() < MANY_OUTLIERS:
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
        """Return the result where more is left than effects and formulas explain, None where they may explain it all.

        Names are sought beside a background then, and which effects seemed likely without one does not matter any more.
        Arguments are those of `conclude`.
        """
        self.least_cost = min(self.least_cost, joint.fit.cost)
        if len(joint.choices) < 2:  # there is nothing to judge again
            return None
        found = conclude(self.problem, joint, alone, steps, (), formulas, posterior, candidates)
        if found.joint.choices or formulas_suffice(self.problem, found.joint, found.strongest_formula):
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
        without = self.problem.fit_part(joint, others)
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
