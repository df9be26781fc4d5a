"""The search for missing effects: in all rows, in a part of them, and beside structure that no library has."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from calibration.gap.adoption import Adopted, adopted
from calibration.gap.background.blocks import displacement_blocks, possible_blocks, smooth_blocks, time_blocks
from calibration.gap.background.breaks import find_break
from calibration.gap.background.causes import names_beside_cause
from calibration.gap.background.naming import Names, evidence_alone, names_beside
from calibration.gap.background.outside import (
    MOST_FORMULAS,
    cost_with_formulas,
    formula_block,
    formulas_log_bayes_factor,
    formulas_suffice,
    is_in_library,
    what_is_left,
)
from calibration.gap.background.search import background_log_bayes_factor
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import OUTLIER, Problem, joint_fit
from calibration.gap.projection import follows_path
from calibration.gap.regimes import effect_in_regime
from calibration.gap.screening import by_family
from calibration.gap.search_result import STRUCTURE, SearchResult
from calibration.gap.stepwise.search import MANY_OUTLIERS, StepwiseSearch
from calibration.identification.reading_steps import in_true_steps
from calibration.identification.refinement import Prior
from calibration.identification.solve import Solution
from calibration.observations import Observations

_REGIME = 15.0  # log Bayes factor, for an effect in a part of the data: its variable and its border are chosen
_LEAST_SAMPLES = 60  # for the evidence of a background to be more than that of a few fixes


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
    whole = StepwiseSearch(problem, families)
    found = _in_regimes(problem, families, whole.run(), whole.least_cost)
    found = _beside_background(problem, families, found)
    broken = find_break(problem, found.joint)
    if broken is not None:
        by_formulas = formulas_log_bayes_factor(problem, found.joint, found.strongest_formula)
        found = replace(found, machine_break=broken if broken.log_bayes_factor > by_formulas else None)
    if seen is solution:
        return found
    # A model counts the noise of readings as its rig file has it, and what is beyond that as scatter.
    if not found.joint.choices:
        return replace(found, adopted=Adopted(solution, solution.fit, reason=found.adopted.reason))
    joint = joint_fit(solution, observations, found.joint.choices, prior, found.joint.fit.x)
    return replace(found, adopted=adopted(solution, joint, found.adopted.reason))


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
    if (alone.fit.weight < OUTLIER).mean() >= MANY_OUTLIERS:
        starts.append(replace(alone, fit=replace(alone.fit, weight=np.ones_like(alone.fit.weight))))
    with_formulas: float | None = None
    for start in starts:
        is_last = start is found.joint
        one = effect_in_regime(problem, start, families, like, least_cost - _REGIME, is_last=is_last)
        if one is None or least_cost - one.joint.fit.cost < _REGIME:
            continue
        if with_formulas is None:
            with_formulas = cost_with_formulas(problem, found.joint, found.strongest_formula)
        if with_formulas - one.joint.fit.cost < _REGIME:
            continue
        if is_last and detect(Grammar(problem.project(one.joint)), problem.rng()).significant:
            continue  # all others are there already
        tried = StepwiseSearch(problem, families, one).run()
        if tried.joint.choices and _leaves_noise(problem, tried):
            return tried
    return found


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
    known = found.joint.choices if names is None else names.joint.choices or found.joint.choices
    is_path = follows_path(problem.solution.samples)  # what wanders along it imitates causes, too
    of_cause = None if is_path else names_beside_cause(problem, families, known, is_open=names is not None)
    names, formulas = (names, formulas) if of_cause is None else (of_cause, ())
    is_doubted = is_path and names is not None
    if names is None or not (names.joint.choices or of_cause or is_doubted):
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
    if not found.needs_background and formulas_suffice(problem, found.joint, found.strongest_formula):
        further, formulas = found.strongest_formula, tuple[Formula, ...]()
        for number in range(MOST_FORMULAS):
            new = tuple(f for f in further if not is_in_library(f, found.candidates.candidates, found.initial))
            if number and not new:  # what is left is of the library, which has been asked beside these
                break
            formulas += new
            names = names_beside(problem, [formula_block(f, n) for n, f in enumerate(formulas)], families, known)
            further = what_is_left(problem, names.joint, formulas)
            if not further:
                return names, formulas
    return names_beside(problem, smooth, families, known, lambda: possible_blocks(context, average)), ()
