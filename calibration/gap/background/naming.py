"""Effects that are certain given a background, where a search without one leaves structure unexplained."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.adoption import finer_forms, refined_choice
from calibration.gap.background.assessment import assess_model, assessments, curves
from calibration.gap.background.blocks import Block
from calibration.gap.background.certificate import certificates
from calibration.gap.background.reading_noise import with_reading_noise
from calibration.gap.background.search import MAP, ODDS, is_curve, linear_system, search_given_background
from calibration.gap.background.system import Model, System
from calibration.gap.background.widening import PossibleBlocks
from calibration.gap.candidates import candidate_at, variants_at
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projected.projection import Integers, Projection, rows_of
from calibration.gap.result import Evidence
from calibration.gap.screening import ScoredEffect, Screen
from calibration.numerics.matrices import gram
from calibration.residual.folds import folds

_FOLDS = 10
_FALSE = 0.05  # largest p-value of a certificate, where the evidence alone is not sufficient
_NEEDED = 5.0  # log Bayes factor from which on a block is needed
_TOLERANCE = 1e-3  # relative increase of held-out squares that counts as rounding


@dataclass(frozen=True)
class Names:
    """Effects that are certain given a background.

    Attributes:
        joint: kinematics with the named effects, without the background.
        evidence: `family@where` -> its evidence.
        open_set: an effect whose family is ambiguous, followed by its alternatives; empty for none.
        harmful: effects that would increase errors of held-out groups and are therefore not named.
        left: further candidates given the model, the most probable first.
        background: each block of the background and its RMS in mm, largest first.
        background_log_bayes_factor: log Bayes factor of the background against noise alone.
        events: events of the background that are still needed.
    """

    joint: JointFit
    evidence: Mapping[str, Evidence]
    open_set: tuple[ScoredEffect, ...]
    harmful: tuple[str, ...]
    left: tuple[ScoredEffect, ...]
    background: tuple[tuple[Block, float], ...]
    background_log_bayes_factor: float
    events: tuple[Block, ...]


def names_given_background(
    problem: Problem,
    blocks: Sequence[Block],
    families: Collection[str],
    known: Sequence[Choice],
    possible: PossibleBlocks | None = None,
) -> Names:
    """Return the effects that are certain given a background.

    Args:
        problem: the data.
        blocks: blocks of the background.
        families: families of effects that may be named.
        known: effects that were found without a background; they are assessed like all others.
        possible: function that yields further blocks to add where the residuals require them; None for none.
    """
    kinematics = problem.with_mild_outliers(problem.kinematics_only())
    system, model = search_given_background(problem, kinematics, blocks, families, known, possible)
    noisier = with_reading_noise(problem, system, model)
    if noisier is not problem:
        found_first = [replace(system.candidates[n].options[option], scale=scale) for n, option, scale in model.effects]
        wide = tuple(system.blocks.values())
        system, model = search_given_background(noisier, kinematics, wide, families, found_first, possible)
    model, found = assess_model(system, model)
    evidence, choices = {}, list[Choice]()
    for one, p in zip(found, certificates(system, model, [set(o.places) for o in found], problem.seed), strict=True):
        number, option, scale = one.effect
        candidate = system.candidates[number]
        is_plain = one.log_odds > ODDS and not is_curve(system, candidate)
        if one.is_certain and (is_plain or p < _FALSE):
            choices.append(replace(candidate.options[option], scale=scale))
            evidence[str(candidate)] = Evidence(one.log_bayes_factor, one.posterior, one.places, float(p))
    joint = _refined(problem, problem.fit(choices, problem.solution.fit.x))
    maps = curves(system, model) if MAP in families else {}
    for where, log_odds in maps.items():
        if f"{MAP}@{where}" not in evidence:
            joint = _with_map(problem, joint, where)
            evidence[f"{MAP}@{where}"] = Evidence(log_odds, float(expit(log_odds)), {where: 1.0}, math.nan)
    joint, harmful = without_harmful(problem, joint)
    kept = {str(c) for c in joint.choices}
    return Names(
        joint,
        {name: own for name, own in evidence.items() if name in kept},
        next(((one.scored, *one.alternatives) for one in found if not one.is_certain and one.alternatives), ()),
        harmful,
        system.screen(model).score(),
        _parts(system, model),
        system.background_log_bayes_factor(model),
        tuple(block for block in blocks if block.kind == "event" and _is_needed(system, model, block)),
    )


def _is_needed(system: System, model: Model, block: Block) -> bool:
    """Return True if a model is clearly less probable without a block."""
    without = system.fit(model.effects, model.scales, without={block.name})
    return model.log_evidence - without.log_evidence > _NEEDED


def evidence_alone(problem: Problem, joint: JointFit, families: Collection[str]) -> dict[str, Evidence]:
    """Return `family@where` -> the evidence of every effect of a fit without a background.

    Args:
        problem: the data.
        joint: kinematics and effects.
        families: families of alternative effects.
    """
    kinematics = problem.kinematics_only()
    fit = replace(kinematics.fit, weight=joint.fit.weight, excess_variance=joint.fit.excess_variance)
    system, chosen = linear_system(problem, replace(kinematics, fit=fit), (), families, joint.choices)
    model = system.fit(system.chosen(chosen), None)
    found = assessments(system, model)
    p = certificates(system, model, [set(one.places) for one in found], problem.seed)
    return {
        str(system.candidates[one.effect[0]]): Evidence(one.log_bayes_factor, one.posterior, one.places, float(value))
        for one, value in zip(found, p, strict=True)
    }


def _parts(system: System, model: Model) -> tuple[tuple[Block, float], ...]:
    """Return each block of the background and its RMS in mm, largest first."""
    amounts, parts = system.amounts(model), []
    for name, block in system.blocks.items():
        moved = system.projection.moved_mm(block.columns) @ (amounts[system.of_block(name)] * block.columns.prior_sigma)
        parts.append((block, float(np.sqrt((moved**2).sum(axis=1).mean()))))
    return tuple(sorted(parts, key=lambda part: -part[1]))


def _refined(problem: Problem, joint: JointFit) -> JointFit:
    """Return a fit with every effect refined."""
    for choice in joint.choices:
        if not finer_forms(joint.context, choice):
            continue
        last = joint.with_last([str(c) for c in joint.choices].index(str(choice)))
        finer = refined_choice(last.context, choice, problem.project(last, without_last=True))
        if finer.settings != choice.settings:
            joint = problem.fit([*last.choices[:-1], finer], last.fit.x)
    return joint


def _with_map(problem: Problem, joint: JointFit, where: str) -> JointFit:
    """Return a fit with the error map of one more joint, in its best variant."""
    projection = problem.project(joint)
    is_possible = where in library()[MAP].places(projection.context.rig)
    forms = variants_at(projection.context, MAP, where) if is_possible else ()
    if not forms:
        return joint
    scored = Screen(projection, [candidate_at(projection.context, projection, MAP, where, forms)]).score()[0]
    if scored.log_bayes_factor <= 0.0:
        return joint
    return problem.fit([*joint.choices, scored.choice], projection.solved(scored.scaled_additions))


def without_harmful(problem: Problem, joint: JointFit) -> tuple[JointFit, tuple[str, ...]]:
    """Return a fit without the effects that increase the errors of held-out groups, and the names of these effects.

    Args:
        problem: the data.
        joint: kinematics and effects.
    """
    harmful: list[str] = []
    while joint.choices:
        projection = problem.project(joint)
        fold = folds(projection.groups, _FOLDS, problem.seed)
        worst = _raising(projection, joint, fold)
        if worst is None:
            worst = _contradicted(problem, joint, projection, fold)
        if worst is None:
            break
        harmful.append(str(joint.choices[worst]))
        joint = _without(problem, joint, worst)
    return joint, tuple(harmful)


def _raising(projection: Projection, joint: JointFit, fold: Integers) -> int | None:
    """Return the number of the effect that most increases errors of weighted held-out fixes; None if none does."""
    whole = _held_out(projection, np.empty(0, dtype=np.intp), fold)
    without = [_held_out(projection, np.r_[joint.slice_of(n)], fold) for n in range(len(joint.choices))]
    worst = int(np.argmin(without))
    return None if without[worst] > whole * (1.0 - _TOLERANCE) else worst


def _contradicted(problem: Problem, joint: JointFit, projection: Projection, fold: Integers) -> int | None:
    """Return the number of the effect that most increases held-out errors if its own outliers are included.

    Fixes that contradict an effect become outliers and are downweighted, which must not count in favour of the effect.
    An example is a step that fits most rows but is wrong by ten times the noise for some.

    Args:
        problem: the data.
        joint: the fit with all effects.
        projection: projection at that fit.
        fold: (m,) number of the fold in which each sample is held out.

    Returns:
        The number; None if no effect causes outliers, or if errors are larger without it.
    """
    is_outlier, most, worst = joint.fit.weight < OUTLIER, 1.0 + _TOLERANCE, None
    if not is_outlier.any():
        return None
    squares = (projection.held_out_mm(fold) ** 2).sum(axis=1)
    for number in range(len(joint.choices)):
        without = _without(problem, joint, number)
        was_outlier = without.fit.weight < OUTLIER
        if not (is_outlier & ~was_outlier).any():
            continue
        counts = ~(is_outlier & was_outlier)
        squares_without = (problem.project(without).held_out_mm(fold) ** 2).sum(axis=1)
        raised = float(squares[counts].sum() / squares_without[counts].sum())
        if raised > most:
            most, worst = raised, number
    return worst


def _without(problem: Problem, joint: JointFit, number: int) -> JointFit:
    """Return a fit without one of the effects."""
    return problem.fit_part(joint, [c for n, c in enumerate(joint.choices) if n != number])


def _held_out(projection: Projection, without: Integers, fold: Integers) -> float:
    """Return the sum of whitened held-out squares of the linear model without some of its columns."""
    design = np.delete(projection.kinematics, without, axis=1)
    products, right = gram(design), design.T @ projection.target
    squares = 0.0
    for number in np.unique(fold):
        rows = rows_of(np.flatnonzero(fold == number))
        own = design[rows]
        x = np.linalg.solve(products - own.T @ own + np.eye(len(products)), right - own.T @ projection.target[rows])
        squares += float(((projection.target[rows] - own @ x) ** 2).sum())
    return squares
