"""The search for what the model lacks: screen, decide, adopt by joint refit, and again while anything can be named."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.fitted import Choice
from calibration.gap.adopt import Adopted, JointFit, adopted, joint_fit
from calibration.gap.found import Found, Turn, concluded
from calibration.gap.grammar import Found as Formula
from calibration.gap.grammar import Grammar
from calibration.gap.problem import OUTLIER, Problem
from calibration.gap.projection import Projection
from calibration.gap.reading_steps import in_true_steps
from calibration.gap.rivals import best_of_each_family, beyond_doubt, explains
from calibration.gap.screen import Place, Screen, Weighed, possible
from calibration.gap.settle import explaining_outliers, settled
from calibration.gap.turn import decide
from calibration.identification.refinement import Prior
from calibration.identification.solve import Solution
from calibration.observations import Observations

MOST_FAMILIES = 4

_STEPS = 30  # of the loop; every place of every adopted family
_PENDING = 3  # sets that are looked behind
_FORMULAS = 3  # that are fitted along
_MANY = 0.02  # share of gross outliers that is more than accidents


class _Search:
    def __init__(self, problem: Problem, families: Collection[str]) -> None:
        self.problem, self.families = problem, tuple(families)

    def run(self, before: Found | None = None) -> Found:
        """The search without the fixes that are far off, and with all where there are many such.

        It goes on after what was found `before`, if anything was.

        To kinematics alone a fix that shows an effect may look like an outlier, as such fixes are often the rare ones:
        those after a step, or where a load has changed its side. Of both searches the one counts whose effects leave
        fewer outliers over.
        """
        counted = self.problem.counted(self.problem.alone())
        weight = counted.fit.weight
        found = self._run(counted, before)
        if (weight < OUTLIER).mean() < _MANY:
            return found
        with_all = self._run(replace(counted, fit=replace(counted.fit, weight=np.ones_like(weight))), before)
        return with_all if with_all.joint.choices and self._outliers(with_all) < self._outliers(found) else found

    def _outliers(self, found: Found) -> int:
        """How many samples the kinematics with what was found weigh out."""
        fit = found.joint.fit if found.joint.choices else self.problem.solution.fit
        return int((fit.weight < OUTLIER).sum())

    def _run(self, joint: JointFit, before: Found | None) -> Found:
        """The search from a fit of the kinematics alone, whose weights are those of the first turn."""
        projection = self.problem.project(joint)
        alone = Turn(joint, projection, (), {}, ())
        first = possible(joint.situation, projection, self.families)
        turns: list[Turn] = []
        certain: dict[str, float] = {}
        pending: list[str] = []
        there, steps = first.places, 0
        if before is not None and before.joint.choices:
            turns, certain = list(before.turns[:-1]), dict(before.certain)
            joint = self.problem.fit(before.joint.choices, joint.fit.x)
            projection = self.problem.open(joint)
            there = self._possible(joint.choices, projection)
        while True:
            decision = decide(self.problem, joint, projection, there)
            steps += 1
            is_set = decision.kind == "set" and len(pending) < _PENDING
            taken = () if decision.joint is None else decision.joint.choices[len(joint.choices) :]
            rested = self._rested(joint, taken) if steps < _STEPS else joint
            if rested is not joint:
                joint, projection = rested, self.problem.open(rested)
                there = self._possible(joint.choices, projection)
                continue
            if not is_set:
                own = taken if decision.kind == "take" else ()
                turns.append(Turn(joint, projection, decision.weighed, decision.posterior, own, decision.reasons))
            if decision.joint is None or steps > _STEPS or not (is_set or decision.kind == "take"):
                break
            # What cannot be told apart yet is there for the time being: others may stand out beside it.
            if is_set:
                pending += [str(c) for c in taken]
            certain |= {str(c): decision.posterior[c.family] for c in taken}
            joint = decision.joint
            projection = self.problem.open(joint)
            there = self._possible(joint.choices, projection)
        rivals = decision.rivals
        for name in pending:
            joint, turn, left = self._judged_again(joint, name)
            if turn is not None and turn.taken:
                turns.insert(-1, turn)
                certain |= {str(c): turn.posterior[c.family] for c in turn.taken}
            elif turn is not None and left and not rivals:
                turns[-1], rivals = turn, left
        joint, renamed = self._renamed(joint, [str(c) for c in joint.choices if str(c) not in pending])
        for turn in renamed:
            turns.insert(-1, turn)
            certain |= {str(c): turn.posterior[c.family] for c in turn.taken}
        joint = explaining_outliers(self.problem, joint)
        return concluded(self.problem, joint, alone, turns, rivals, decision.formulas, certain, first)

    def _rested(self, joint: JointFit, taken: Sequence[Choice]) -> JointFit:
        """The fit with its effects at rest, before what is to be `taken` beside them comes in.

        What is there may have a better form by now, all the more at the same place; and where nothing more is taken,
        one that explains outliers as well.
        """
        places = {c.where for c in taken}
        rested = settled(self.problem, joint, [c for c in joint.choices if not taken or c.where in places])
        return rested if taken or rested is not joint else explaining_outliers(self.problem, joint)

    def _renamed(self, joint: JointFit, names: Sequence[str]) -> tuple[JointFit, list[Turn]]:
        """The fit with what took one of the names when others were not known yet and has another one beside them."""
        turns: list[Turn] = []
        for name in names:
            if len({c.family for c in joint.choices}) == 1:
                break
            if name not in map(str, joint.choices) or self._is_plain(joint, name):
                continue
            other, turn, _ = self._judged_again(joint, name)
            if turn is not None and turn.taken and name not in map(str, turn.taken):
                joint = settled(self.problem, other, other.choices)
                turns.append(turn)
        return joint, turns

    def _is_plain(self, joint: JointFit, name: str) -> bool:
        """Whether nothing comes near what took a name, beside all else that is there: it would take it again."""
        joint = joint.with_last([str(c) for c in joint.choices].index(name))
        projection = self.problem.project(joint, without_last=True)
        weighed = Screen(projection, self._possible(joint.choices[:-1], projection)).weigh()
        return str(weighed[0].place) == name and beyond_doubt(best_of_each_family(weighed))

    def _judged_again(self, joint: JointFit, name: str) -> tuple[JointFit, Turn | None, tuple[Weighed, ...]]:
        """What could not be told from others, now that all else is known: the fit with it, or without and the set."""
        if name not in map(str, joint.choices):
            return joint, None, ()
        others = [c for c in joint.choices if str(c) != name]
        without = self.problem.fit(others, joint.start(others))
        # What all together explain is no outlier to a part of it.
        projection = self.problem.open(replace(without, fit=replace(without.fit, weight=joint.fit.weight)))
        decision = decide(self.problem, without, projection, self._possible(others, projection))
        if decision.kind != "take" or decision.joint is None:
            turn = Turn(without, projection, decision.weighed, decision.posterior, (), decision.reasons)
            return without, turn, decision.rivals
        taken = decision.joint.choices[len(others) :]
        turn = Turn(without, projection, decision.weighed, decision.posterior, taken, decision.reasons)
        return decision.joint, turn, ()

    def _possible(self, there: Sequence[Choice], projection: Projection) -> tuple[Place, ...]:
        """All places for what may still be missing: of no other families once there are as many as a model takes."""
        taken = {c.family for c in there}
        allowed = [f for f in self.families if f in taken] if len(taken) >= MOST_FAMILIES else self.families
        return possible(projection.situation, projection, allowed, [str(c) for c in there]).places


def _beside_formulas(problem: Problem, families: Collection[str], found: Found) -> Found:
    """What was found, and what is beyond doubt beside the formulas of what no library has.

    On a machine there is always something that no library has, and clear effects beside it. The search goes on with a
    formula fitted along, one more each time: of several that are found together others may be an effect in words. The
    model that comes of it has the effects alone; what they leave is told as ever.

    Args:
        problem: the data.
        families: that may be named.
        found: without formulas fitted along. It stays as it is where nothing more is named, or a set is not settled.
    """
    further, formulas = found, list[Formula]()
    for _ in range(_FORMULAS):
        new = next((f for f in further.strange if not _has_name(f, further)), None)
        if new is None:
            break
        formulas.append(new)
        further = _Search(problem.beside(formulas), families).run(further)
    named, pending = {str(c) for c in further.joint.choices}, {str(w.place) for w in found.rivals}
    if not {str(c) for c in found.joint.choices} < named or (pending and not pending & named):
        return found
    fits = [problem.fit(turn.fit.choices, problem.solution.fit.x) for turn in further.turns]
    turns = [replace(t, fit=fit, projection=problem.project(fit)) for t, fit in zip(further.turns, fits, strict=True)]
    joint, left = fits[-1], Grammar(turns[-1].projection)
    return replace(
        found,
        adopted=adopted(problem.solution, joint, further.adopted.reason),
        joint=joint,
        turns=tuple(turns),
        rivals=(),
        formulas=left.found() or tuple(formulas),
        certain=further.certain,
        left=left,
    )


def _has_name(formula: Formula, found: Found) -> bool:
    """Whether an effect that was weighed in the last turn explains what a formula does.

    What does not show by itself, for all that hides it, is no more than a formula.
    """
    over = found.left.projection
    shows = formula.shows_beside(np.empty((len(over.residual), 0)), over.residual)
    weighed = found.turns[-1].weighed if shows else ()
    return any(w.log_bayes_factor > 0.0 and explains(w, formula, over) for w in weighed)


def search(
    solution: Solution,
    observations: Observations,
    families: Collection[str],
    *,
    prior: Prior = "recalibration",
    seed: int = 0,
) -> Found:
    """Find the effects that the data ask for.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        families: that may be named.
        prior: as the solution was found with.
        seed: of half-samples and folds.
    """
    seen = in_true_steps(solution, observations, prior)
    problem = Problem(seen, observations, prior, seed)
    found = _beside_formulas(problem, families, _Search(problem, families).run())
    if seen is solution:
        return found
    # A model counts the noise of readings as its rig file has it, and what is beyond that as scatter.
    if not found.joint.choices:
        return replace(found, adopted=Adopted(solution, solution.fit, reason=found.adopted.reason))
    joint = joint_fit(solution, observations, found.joint.choices, prior, found.joint.fit.x)
    return replace(found, adopted=adopted(solution, joint, found.adopted.reason))
