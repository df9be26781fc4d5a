"""Adoption of effects into a solution: those that the caller asks for by name, in their best forms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from scipy.special import softmax

from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library, parse_effects
from calibration.errors import DataError
from calibration.gap.candidates import LEAST_KNOWN, candidate_at, variants_at
from calibration.gap.joint_fit import JointFit, joint_fit, projected
from calibration.gap.projection import Projection
from calibration.gap.screening import LOG_SCALE_ODDS, SCALES, Screen
from calibration.identification.refinement import Fit, Prior
from calibration.identification.solve import Solution
from calibration.observations import Observations

_CHOICES = 4  # of variants: the noise that they are scored with depends on which are in


@dataclass(frozen=True)
class Adopted:
    """Kinematics and effects together.

    Attributes:
        solution: with the joint fit and its additions; that of the kinematics where no effect was adopted.
        geometric: the fit of the kinematics alone.
        effects: those that were adopted.
        reason: why these, or why none, a clause.
        warnings: sentences for people.
        structured: True if the remaining errors are known to depend on something.
    """

    solution: Solution
    geometric: Fit
    effects: tuple[FittedEffect, ...] = ()
    reason: str = "switched off"
    warnings: tuple[str, ...] = ()
    structured: bool = False


def adopt(solution: Solution, observations: Observations, effects: str, *, prior: Prior = "recalibration") -> Adopted:
    """Adopt effects that are asked for by name.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        effects: `none`, or FAMILY@WHERE,...
        prior: of the solution.

    Raises:
        ValueError: as `parse_effects`.
        DataError: an effect lacks a column, or cannot be at its place.
    """
    if effects == "none":
        return Adopted(solution, solution.fit)
    situation = EffectContext(solution.chain, solution.fit.x[: len(solution.chain)], observations)
    names = parse_effects(effects, solution.chain.rig)
    for name, where in names:
        family = library()[name]
        if family.known(situation, where).mean() < LEAST_KNOWN:
            raise DataError("observations", f"{name}@{where} needs {family.needs(where)}, in half of the rows at least")
        if not family.variants(situation, where):
            raise DataError("observations", f"{name}@{where} cannot do anything in any pose; leave it out")
    joint = _in_finest_forms(solution, _best_variants(solution, situation, names, prior), prior)
    warnings = tuple(
        f"{choice}: {name} came out beyond what is physical; it may stand for another effect"
        for number, choice in enumerate(joint.choices)
        for name in joint.beyond(number)
    )
    return adopted(solution, joint, "asked for by name", warnings)


def adopted(solution: Solution, joint: JointFit, reason: str, warnings: tuple[str, ...] = ()) -> Adopted:
    """Return the solution of the kinematics alone with the effects of a joint fit."""
    together = replace(solution, fit=joint.fit, additions=joint.additions)
    return Adopted(together, solution.fit, joint.effects, reason, warnings)


def refined_choice(situation: EffectContext, choice: Choice, over: Projection) -> Choice:
    """Return the finest form of an effect near the chosen one.

    Args:
        situation: of the observations.
        choice: the effect.
        over: a projection that does not project it out.
    """
    finer = finer_forms(situation, choice)
    if not finer:
        return choice
    screen = Screen(over, [candidate_at(situation, over, choice.family, choice.where, finer)])
    probability = softmax([screen.log_bayes_factor([(0, option)]) for option in range(len(finer))])
    return replace(choice, settings=library()[choice.family].settled([c.settings for c in finer], probability))


def finer_forms(situation: EffectContext, choice: Choice) -> tuple[Choice, ...]:
    """Return finer forms of an effect near the given one, itself among them; none where there is nothing finer."""
    finer = library()[choice.family].refined(situation, choice.where, choice.settings)
    return tuple(replace(choice, settings=settings) for settings in finer) if len(finer) > 1 else ()


def _in_finest_forms(solution: Solution, joint: JointFit, prior: Prior) -> JointFit:
    """Return the fit with each effect in its finest form, given the others."""
    for choice in joint.choices:
        if not finer_forms(joint.situation, choice):
            continue
        observations = joint.situation.observations
        others = [c for c in joint.choices if c != choice]
        tried = joint_fit(solution, observations, [*others, choice], prior, joint.start([*others, choice]))
        finer = refined_choice(tried.situation, choice, projected(solution, tried, without_last=True))
        joint = joint_fit(
            solution, observations, [finer if c == choice else c for c in joint.choices], prior, joint.fit.x
        )
    return joint


def _best_variants(
    solution: Solution, situation: EffectContext, names: Sequence[tuple[str, str]], prior: Prior
) -> JointFit:
    """Fit the variants of the greatest joint evidence, changed one at a time until none is better."""
    observations = situation.observations
    variants = [variants_at(situation, name, where) for name, where in names]
    chosen = [(0, 1.0)] * len(names)
    joint = joint_fit(solution, observations, _scaled(variants, chosen), prior)
    for _ in range(_CHOICES):
        over = Projection(solution, joint.situation, joint.fit, joint.additions)
        candidates = [
            candidate_at(joint.situation, over, name, where, own)
            for (name, where), own in zip(names, variants, strict=True)
        ]
        screen, before = Screen(over, candidates), list(chosen)
        for _ in range(_CHOICES):
            start = list(chosen)
            for number, candidate in enumerate(candidates):
                beside = screen.beside({at: one for at, one in enumerate(chosen) if at != number})
                values = {
                    (option, scale): beside.together(number, option, scale)
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
