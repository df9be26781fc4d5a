"""Effects that are adopted come to rest: those that others make superfluous go, the others take their best forms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.fitted import Choice
from calibration.gap.adopt import JointFit
from calibration.gap.problem import OUTLIER, Problem
from calibration.gap.projection import Projection
from calibration.gap.rivals import together
from calibration.gap.screen import Place, Screen, place_of, variants_at
from calibration.identification.additions import joined

_BETTER = 1.0  # in log evidence, to take another form of what is there
_FORMS = 5  # times that the forms of what is there are changed, before all else is looked at again


def settled(problem: Problem, joint: JointFit, again: Sequence[Choice]) -> JointFit:
    """The fit without those of its effects that others make superfluous, and with the better forms of the rest.

    Args:
        problem: the data.
        joint: kinematics and effects; comes back itself where nothing changes.
        again: those of its effects to look at.
    """
    names = {str(c) for c in again}
    for _ in range(_FORMS):
        before = joint
        joint = _better(problem, before, [c for c in before.choices if str(c) in names])
        if joint is before:
            break
    return joint


def explaining_outliers(problem: Problem, joint: JointFit) -> JointFit:
    """The fit with its effects in forms that explain its outliers too; comes back itself where these are less likely.

    The few fixes beyond the loads of all others are outliers to a straight line, and the only ones that show a curve.

    Args:
        problem: the data.
        joint: kinematics and effects.
    """
    if (joint.fit.weight >= OUTLIER).all():
        return joint
    every = replace(joint, fit=replace(joint.fit, weight=np.ones_like(joint.fit.weight)))
    tried = settled(problem, every, joint.choices)
    return tried if tried is not every and tried.fit.cost < joint.fit.cost else joint


def _better(problem: Problem, joint: JointFit, again: Sequence[Choice]) -> JointFit:
    """One step of `settled`, by the linear model about the fit."""
    if len(joint.choices) < 2 or not again:
        return joint
    over = Projection(problem.solution, joint.situation, joint.fit, joint.additions)
    places = [_with_variants(joint, over, choice, is_open=choice in again) for choice in joint.choices]
    screen = Screen(over, places)
    chosen = {number: (0, choice.scale) for number, choice in enumerate(joint.choices)}
    for number, choice in enumerate(joint.choices):
        if choice not in again:
            continue
        others = {k: v for k, v in chosen.items() if k != number}
        without = together(screen, others)
        values = {
            one: together(screen, {**others, number: one}) + float(places[number].log_odds[one[0]])
            for one in itertools.product(range(len(places[number].options)), {1.0, choice.scale})
        }
        best = max(values, key=values.__getitem__)
        if values[best] < without:
            chosen = others
        elif values[best] > values[chosen[number]] + _BETTER:
            chosen[number] = best
    kept = [replace(places[n].options[option], scale=scale) for n, (option, scale) in chosen.items()]
    if kept == list(joint.choices):
        return joint
    parts = [
        replace(part, prior_sigma=part.prior_sigma * scale)
        for n, (option, scale) in chosen.items()
        for part in [places[n].additions[option]]
    ]
    return problem.fit(kept, over.solved(joined(parts, len(over.samples))))


def _with_variants(joint: JointFit, over: Projection, choice: Choice, *, is_open: bool) -> Place:
    """The place of an effect as it is, and with its other variants where it is open which it has."""
    options = [replace(choice, scale=1.0)]
    if is_open:
        variants = variants_at(joint.situation, choice.family, choice.where)
        options += [v for v in variants if v.settings != choice.settings]
    return place_of(joint.situation, over, choice.family, choice.where, options)
