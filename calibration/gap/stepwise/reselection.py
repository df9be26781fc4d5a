"""Reselection: removal of effects that others make superfluous, and better variants of the rest."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.columns import joined
from calibration.effects.fitted import Choice
from calibration.gap.candidates import CandidateEffect, candidate_at, variants_at
from calibration.gap.joint_fit import OUTLIER, JointFit, Problem
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import Screen

_BETTER = 1.0  # log Bayes factor required to change the variant of an adopted effect
_CONVERGED = 0.1  # nats; fits that converged to the same optimum differ by less
_FORMS = 5  # largest number of rounds of changing variants before all candidates are scored again


def reselect(problem: Problem, joint: JointFit, again: Sequence[Choice]) -> JointFit:
    """Return the fit without effects that others make superfluous, and with the best variants of the rest.

    Args:
        problem: the data.
        joint: kinematics and effects; the same object is returned if nothing changes.
        again: the effects to reselect.
    """
    names = {str(c) for c in again}
    for _ in range(_FORMS):
        before = joint
        joint = _reselect_once(problem, before, [c for c in before.choices if str(c) in names])
        if joint is before:
            break
    return joint


def explain_outliers(problem: Problem, joint: JointFit) -> JointFit:
    """Return the fit with variants of its effects that also explain its outliers, or the same fit if not better.

    For example, a few fixes at loads beyond those of all others are outliers to a linear variant, but are the only ones
    that reveal a curve.

    Args:
        problem: the data.
        joint: kinematics and effects.
    """
    if (joint.fit.weight >= OUTLIER).all():
        return joint
    every = replace(joint, fit=replace(joint.fit, weight=np.ones_like(joint.fit.weight)))
    tried = reselect(problem, every, joint.choices)
    return tried if tried is not every and tried.fit.cost < joint.fit.cost - _CONVERGED else joint


def _reselect_once(problem: Problem, joint: JointFit, again: Sequence[Choice]) -> JointFit:
    """Reselect each effect once, in the linear model at the fit."""
    if len(joint.choices) < 2 or not again:
        return joint
    over = Projection(problem.solution, joint.context, joint.fit, joint.additions)
    candidates = [_with_variants(joint, over, choice, is_open=choice in again) for choice in joint.choices]
    screen = Screen(over, candidates)
    chosen = {number: (0, choice.scale) for number, choice in enumerate(joint.choices)}
    for number, choice in enumerate(joint.choices):
        if choice not in again:
            continue
        others = {k: v for k, v in chosen.items() if k != number}
        given = screen.given(others)
        values = {
            one: given.together(number, *one) + float(candidates[number].log_odds[one[0]])
            for one in itertools.product(range(len(candidates[number].options)), {1.0, choice.scale})
        }
        best = max(values, key=values.__getitem__)
        if values[best] < given.log_bayes_factor:
            chosen = others
        elif values[best] > values[chosen[number]] + _BETTER:
            chosen[number] = best
    kept = [replace(candidates[n].options[option], scale=scale) for n, (option, scale) in chosen.items()]
    if kept == list(joint.choices):
        return joint
    parts = [
        replace(part, prior_sigma=part.prior_sigma * scale)
        for n, (option, scale) in chosen.items()
        for part in [candidates[n].additions[option]]
    ]
    return problem.fit(kept, over.solved(joined(parts, len(over.samples))))


def _with_variants(joint: JointFit, over: Projection, choice: Choice, *, is_open: bool) -> CandidateEffect:
    """Return the candidate of an effect in its present variant, and if `is_open` also in its other variants."""
    options = [replace(choice, scale=1.0)]
    if is_open:
        variants = variants_at(joint.context, choice.family, choice.where)
        options += [replace(v, regime=choice.regime) for v in variants if v.settings != choice.settings]
    return candidate_at(joint.context, over, choice.family, choice.where, options)
