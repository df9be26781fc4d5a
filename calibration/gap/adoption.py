"""Adoption of named effects into a solution, in their best variants."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from scipy.special import softmax

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library, parse_effects
from calibration.errors import DataError
from calibration.gap.candidates import candidate_at, variants_at
from calibration.gap.joint_fit import JointFit, joint_fit, projected
from calibration.gap.projected.projection import Projection
from calibration.gap.screening import LOG_SCALE_ODDS, SCALES, Screen
from calibration.identification.refinement import Fit, Prior
from calibration.identification.solve import Solution
from calibration.observations import Observations

_CHOICES = 4  # rounds of selecting variants, as the noise used for scoring depends on the selected ones


@dataclass(frozen=True)
class Adopted:
    """Kinematics and effects together.

    Attributes:
        solution: solution with the joint fit and its additions; without effects, the solution of the kinematics.
        geometric: the fit of the kinematics alone.
        effects: the adopted effects.
        reason: clause that explains the choice of effects, or why there are none.
        warnings: sentences for the user.
        structured: True if the remaining errors are known to be structured, not just noise.
    """

    solution: Solution
    geometric: Fit
    effects: tuple[FittedEffect, ...] = ()
    reason: str = "switched off"
    warnings: tuple[str, ...] = ()
    structured: bool = False


def adopt(solution: Solution, observations: Observations, effects: str, *, prior: Prior = "recalibration") -> Adopted:
    """Adopt named effects.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        effects: `none`, or FAMILY@WHERE,...
        prior: prior of the solution.

    Raises:
        ValueError: as `parse_effects`.
        DataError: an effect lacks a column, or cannot occur at its place.
    """
    if effects == "none":
        return Adopted(solution, solution.fit)
    context = EffectContext(solution.chain, solution.fit.x[: len(solution.chain)], observations)
    names = parse_effects(effects, solution.chain.rig)
    for name, where in names:
        family = library()[name]
        if family.known(context, where).mean() < family.least_known:
            share = "" if family.least_known == 1.0 else ", in at least half of the rows"
            raise DataError("observations", f"{name}@{where} needs {family.needs(where)}{share}")
        if not family.variants(context, where):
            raise DataError("observations", f"{name}@{where} has no effect in any pose; leave it out")
    joint = _in_finest_forms(solution, _best_variants(solution, context, names, prior), prior)
    warnings = tuple(
        f"{choice}: {name} is beyond its physical limits; it may stand for a different effect"
        for number, choice in enumerate(joint.choices)
        for name in joint.beyond_limits(number)
    )
    return adopted(solution, joint, "requested by name", warnings)


def adopted(solution: Solution, joint: JointFit, reason: str, warnings: tuple[str, ...] = ()) -> Adopted:
    """Return the solution of the kinematics with the effects of a joint fit.

    Args:
        solution: the kinematics alone.
        joint: the joint fit.
        reason: as in `Adopted`.
        warnings: as in `Adopted`.
    """
    together = replace(solution, fit=joint.fit, additions=joint.additions)
    return Adopted(together, solution.fit, joint.effects, reason, warnings)


def refined_choice(context: EffectContext, choice: Choice, over: Projection) -> Choice:
    """Return the effect with refined settings near the chosen ones.

    Args:
        context: context of the observations.
        choice: the effect.
        over: a projection without this effect.
    """
    finer = finer_forms(context, choice)
    if not finer:
        return choice
    screen = Screen(over, [candidate_at(context, over, choice.family, choice.where, finer)])
    probability = softmax([screen.log_bayes_factor([(0, option)]) for option in range(len(finer))])
    return replace(
        choice, settings=library()[choice.family].posterior_settings([c.settings for c in finer], probability)
    )


def finer_forms(context: EffectContext, choice: Choice) -> tuple[Choice, ...]:
    """Return finer variants of an effect near the given one, including it; empty if there are none."""
    finer = library()[choice.family].refined(context, choice.where, choice.settings)
    return tuple(replace(choice, settings=settings) for settings in finer) if len(finer) > 1 else ()


def _in_finest_forms(solution: Solution, joint: JointFit, prior: Prior) -> JointFit:
    """Return the fit with each effect refined, given the others."""
    for choice in joint.choices:
        if not finer_forms(joint.context, choice):
            continue
        observations = joint.context.observations
        others = [c for c in joint.choices if c != choice]
        tried = joint_fit(solution, observations, [*others, choice], prior, joint.start([*others, choice]))
        finer = refined_choice(tried.context, choice, projected(solution, tried, without_last=True))
        joint = joint_fit(
            solution, observations, [finer if c == choice else c for c in joint.choices], prior, joint.fit.x
        )
    return joint


def _best_variants(
    solution: Solution, context: EffectContext, names: Sequence[tuple[str, str]], prior: Prior
) -> JointFit:
    """Fit the variants of maximum joint evidence, by changing one at a time until there is no improvement."""
    observations = context.observations
    variants = [variants_at(context, name, where) for name, where in names]
    chosen = [(0, 1.0)] * len(names)
    joint = joint_fit(solution, observations, _scaled(variants, chosen), prior)
    for _ in range(_CHOICES):
        over = Projection(solution, joint.context, joint.fit, joint.additions)
        candidates = [
            candidate_at(joint.context, over, name, where, own)
            for (name, where), own in zip(names, variants, strict=True)
        ]
        screen, before = Screen(over, candidates), list(chosen)
        for _ in range(_CHOICES):
            start = list(chosen)
            for number, candidate in enumerate(candidates):
                given = screen.given({at: one for at, one in enumerate(chosen) if at != number})
                values = {
                    (option, scale): given.together(number, option, scale)
                    + float(candidate.log_odds[option])
                    + LOG_SCALE_ODDS[scale]
                    for option, scale in itertools.product(range(len(candidate.options)), SCALES)
                }
                chosen[number] = max(values, key=values.__getitem__)
            if chosen == start:
                break
        if chosen == before:
            break
        joint = joint_fit(solution, observations, _scaled(variants, chosen), prior)
    return joint


def _scaled(variants: Sequence[Sequence[Choice]], chosen: Sequence[tuple[int, float]]) -> list[Choice]:
    return [replace(own[option], scale=scale) for own, (option, scale) in zip(variants, chosen, strict=True)]
