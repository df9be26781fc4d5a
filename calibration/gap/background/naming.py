"""Names beside a background: what a search that leaves structure over can still say for certain."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.adoption import finer_forms, refined_choice
from calibration.gap.background.blocks import Block
from calibration.gap.background.certificate import certificates
from calibration.gap.background.judgement import curves, judged, judgements
from calibration.gap.background.reading_noise import with_reading_noise
from calibration.gap.background.search import MAP, ODDS, is_curve, linear_system, search_beside
from calibration.gap.background.system import Model, System
from calibration.gap.background.widening import PossibleBlocks
from calibration.gap.candidates import candidate_at, variants_at
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projection import Integers, Projection, rows_of
from calibration.gap.result import Evidence
from calibration.gap.screening import ScoredEffect, Screen
from calibration.numerics.matrices import gram
from calibration.residual.folds import folds

_FOLDS = 10
_FALSE = 0.05  # p-value of a certificate, where the evidence leaves a doubt
_NEEDED = 5.0  # log Bayes factor of a block
_HARM = 1e-3  # share by which held-out squares may grow: rounding, and no more


@dataclass(frozen=True)
class Names:
    """Effects that are certain beside a background.

    Attributes:
        joint: kinematics with the effects that are named, without the background.
        evidence: `family@where` -> its evidence.
        open_set: an effect whose family is open and what it may be instead; empty for none.
        harmful: effects that would raise errors of held-out groups, and so are not named.
        left: what the library explains of the rest, the most probable first.
        background: each part of the background and its RMS in mm, the largest first.
        background_log_bayes_factor: of the background against noise alone.
        events: those of the background that no effect makes superfluous.
    """

    joint: JointFit
    evidence: Mapping[str, Evidence]
    open_set: tuple[ScoredEffect, ...]
    harmful: tuple[str, ...]
    left: tuple[ScoredEffect, ...]
    background: tuple[tuple[Block, float], ...]
    background_log_bayes_factor: float
    events: tuple[Block, ...]


def names_beside(
    problem: Problem,
    blocks: Sequence[Block],
    families: Collection[str],
    known: Sequence[Choice],
    possible: PossibleBlocks | None = None,
) -> Names:
    """Return the effects that are beyond doubt beside a background.

    Args:
        problem: the data.
        blocks: of the background.
        families: of effects that may be named.
        known: effects that were found without a background; they are judged like all others.
        possible: yields blocks to widen the background by where the errors ask for them; None for none.
    """
    kinematics = problem.with_mild_outliers(problem.kinematics_only())
    system, model = search_beside(problem, kinematics, blocks, families, known, possible)
    noisier = with_reading_noise(problem, system, model)
    if noisier is not problem:
        found_first = [replace(system.candidates[n].options[option], scale=scale) for n, option, scale in model.effects]
        wide = tuple(system.blocks.values())
        system, model = search_beside(noisier, kinematics, wide, families, found_first, possible)
    model, found = judged(system, model)
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
    """True if a model is plainly less probable without a block."""
    without = system.fit(model.effects, model.scales, without={block.name})
    return model.log_evidence - without.log_evidence > _NEEDED


def evidence_alone(problem: Problem, joint: JointFit, families: Collection[str]) -> dict[str, Evidence]:
    """Return `family@where` -> the evidence of every effect of a fit beside which there is no background.

    Args:
        problem: the data.
        joint: kinematics and effects.
        families: of effects that might be there instead.
    """
    kinematics = problem.kinematics_only()
    fit = replace(kinematics.fit, weight=joint.fit.weight, excess_variance=joint.fit.excess_variance)
    system, chosen = linear_system(problem, replace(kinematics, fit=fit), (), families, joint.choices)
    model = system.fit(system.chosen(chosen), None)
    found = judgements(system, model)
    p = certificates(system, model, [set(one.places) for one in found], problem.seed)
    return {
        str(system.candidates[one.effect[0]]): Evidence(one.log_bayes_factor, one.posterior, one.places, float(value))
        for one, value in zip(found, p, strict=True)
    }


def _parts(system: System, model: Model) -> tuple[tuple[Block, float], ...]:
    """Return each part of the background and its RMS in mm, the largest first."""
    amounts, parts = system.amounts(model), []
    for name, block in system.blocks.items():
        moved = system.projection.moved_mm(block.columns) @ (amounts[system.of_block(name)] * block.columns.prior_sigma)
        parts.append((block, float(np.sqrt((moved**2).sum(axis=1).mean()))))
    return tuple(sorted(parts, key=lambda part: -part[1]))


def _refined(problem: Problem, joint: JointFit) -> JointFit:
    """Return a fit with every effect in its finest form."""
    for choice in joint.choices:
        if not finer_forms(joint.situation, choice):
            continue
        last = joint.with_last([str(c) for c in joint.choices].index(str(choice)))
        finer = refined_choice(last.situation, choice, problem.project(last, without_last=True))
        if finer.settings != choice.settings:
            joint = problem.fit([*last.choices[:-1], finer], last.fit.x)
    return joint


def _with_map(problem: Problem, joint: JointFit, where: str) -> JointFit:
    """Return a fit with the map of one more joint, in its best variant."""
    projection = problem.project(joint)
    is_possible = where in library()[MAP].places(projection.situation.rig)
    forms = variants_at(projection.situation, MAP, where) if is_possible else ()
    if not forms:
        return joint
    scored = Screen(projection, [candidate_at(projection.situation, projection, MAP, where, forms)]).score()[0]
    if scored.log_bayes_factor <= 0.0:
        return joint
    return problem.fit([*joint.choices, scored.choice], projection.solved(scored.scaled_additions))


def without_harmful(problem: Problem, joint: JointFit) -> tuple[JointFit, tuple[str, ...]]:
    """Return a fit without the effects that raise the errors of held-out groups, and the names of these."""
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
    """Return the number of the effect that most raises the errors of fixes that count; None where none does."""
    whole = _held_out(projection, np.empty(0, dtype=np.intp), fold)
    without = [_held_out(projection, np.r_[joint.slice_of(n)], fold) for n in range(len(joint.choices))]
    worst = int(np.argmin(without))
    return None if without[worst] > whole * (1.0 - _HARM) else worst


def _contradicted(problem: Problem, joint: JointFit, projection: Projection, fold: Integers) -> int | None:
    """Return the number of the effect that most raises the errors of all fixes, outliers to it alone among them.

    Fixes that contradict an effect are outliers beside it and do not count, which says nothing for it: a step that most
    rows gain by, and to which some are ten times the noise off.

    Args:
        problem: the data.
        joint: the fit with all effects.
        projection: about that fit.
        fold: (m,) in which of the folds each sample is left out.

    Returns:
        None where no effect makes outliers, or errors are greater without it.
    """
    is_outlier, most, worst = joint.fit.weight < OUTLIER, 1.0 + _HARM, None
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
    """Return the whitened squares of held-out groups by the linear model without some of its columns."""
    design = np.delete(projection.kinematics, without, axis=1)
    products, right = gram(design), design.T @ projection.target
    squares = 0.0
    for number in np.unique(fold):
        rows = rows_of(np.flatnonzero(fold == number))
        own = design[rows]
        x = np.linalg.solve(products - own.T @ own + np.eye(len(products)), right - own.T @ projection.target[rows])
        squares += float(((projection.target[rows] - own @ x) ** 2).sum())
    return squares
