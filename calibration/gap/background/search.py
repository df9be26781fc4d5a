"""Search for effects given a background: the effect of greatest gain is added until none is certain."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.background.blocks import Block
from calibration.gap.background.evidence import Scales
from calibration.gap.background.system import Chosen, Effect, Model, System
from calibration.gap.background.weights import reweighted
from calibration.gap.background.widening import PossibleBlocks, further_blocks
from calibration.gap.candidates import CandidateEffect, candidate_at, candidate_effects
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.screening import ScoredEffect

MAP = "joint_error_map"  # the effect that corresponds to curves of the background
ODDS = math.log(999.0)  # log odds required of an effect against none
ODDS_OF_TWO = math.log(19.0)  # log odds required of one effect against another that is equally probable a priori
_LIKE_A_CURVE = 0.02  # a candidate is like a curve if the curve leaves at most this share of its variance
_TRIED = 6  # number of candidates whose gain is computed with refitted scales
_MOST = 60  # largest number of effects
_PASSES = 4


@dataclass(frozen=True)
class Gain:
    """A candidate, and the gain of a model by it.

    Attributes:
        scored: the candidate.
        log_bayes_factor: log Bayes factor against the model without it, with all scales of the background refitted.
        log_likelihood_gain: the same for the best variant and scale only, without averaging over variants and scales.
        log_odds: `log_bayes_factor` with prior odds.
        model: the model with the candidate.
    """

    scored: ScoredEffect
    log_bayes_factor: float
    log_likelihood_gain: float
    log_odds: float
    model: Model


def search_given_background(
    problem: Problem,
    joint: JointFit,
    blocks: Sequence[Block],
    families: Collection[str],
    known: Sequence[Choice],
    possible: PossibleBlocks | None = None,
) -> tuple[System, Model]:
    """Return the linear model with all effects that are certain given a background.

    Outlier weights and scatter are updated given the effects found, and the search continues from there. An effect
    absorbs errors of others that are not found yet, so its estimate may exceed its hard limits for a while. Therefore
    limits are not checked in the search but in the later assessment of effects.

    Args:
        problem: the data.
        joint: the kinematics alone, with initial weights.
        blocks: blocks of the background.
        families: families of effects that may be named.
        known: initial effects.
        possible: function that yields further blocks to add where the residuals require them; None for none.
    """
    scales: Scales | None = None
    found: tuple[Effect, ...] = ()
    for number in range(_PASSES):
        fit, scales = reweighted(problem, joint, blocks, found, scales)
        joint = replace(joint, fit=fit)
        system, initial = linear_system(problem, joint, blocks, families, known)
        effects = found if number else initial
        model = add_certain_effects(system, system.fit(system.chosen(effects), scales), any_size=True)
        found = tuple((system.candidates[n], option, scale) for n, option, scale in model.effects)
        scales = model.scales
        further = further_blocks(system, model, possible) if possible else ()
        if number and len(found) == len(effects) and not further:
            break
        blocks = [*blocks, *further]
    return system, model


def background_log_bayes_factor(problem: Problem, joint: JointFit, blocks: Sequence[Block]) -> float:
    """Return the log Bayes factor of a background against noise alone, given kinematics and effects.

    Args:
        problem: the data.
        joint: kinematics and effects.
        blocks: blocks of the background.
    """
    system, effects, scales = system_given_effects(problem, blocks, joint.choices)
    return system.background_log_bayes_factor(system.fit(effects, scales))


def system_given_effects(
    problem: Problem, blocks: Sequence[Block], known: Sequence[Choice]
) -> tuple[System, list[Chosen], Scales]:
    """Return the linear model with known effects and a background, with the outlier weights given all of these.

    Args:
        problem: the data.
        blocks: blocks of the background.
        known: the effects.

    Returns:
        The linear model, the effects in it in the same order, and the scales of the background given them.
    """
    joint, scales = kinematics_given_effects(problem, blocks, known)
    system, effects = linear_system(problem, joint, blocks, (), known)
    return system, system.chosen(effects), scales


def kinematics_given_effects(
    problem: Problem, blocks: Sequence[Block], known: Sequence[Choice]
) -> tuple[JointFit, Scales]:
    """Return the kinematics alone with the outlier weights given known effects and a background, and its scales.

    Arguments are those of `system_given_effects`.
    """
    kinematics = problem.with_mild_outliers(problem.kinematics_only())
    _, effects = linear_system(problem, kinematics, (), (), known)
    fit, scales = reweighted(problem, kinematics, blocks, effects, None)
    return replace(kinematics, fit=fit), scales


def linear_system(
    problem: Problem, joint: JointFit, blocks: Sequence[Block], families: Collection[str], known: Sequence[Choice]
) -> tuple[System, tuple[Effect, ...]]:
    """Return the linear model at a fit, and the known effects in it.

    Args:
        problem: the data.
        joint: the kinematics alone, with the weights and scatter to use.
        blocks: blocks of a background.
        families: families of the candidates, without joint error maps, which the background represents.
        known: effects that are always candidates, in their known variants.
    """
    projection, context = problem.project(joint), joint.context
    initial = [candidate_at(context, projection, c.family, c.where, [replace(c, scale=1.0)]) for c in known]
    every = candidate_effects(context, projection, [name for name in families if name != MAP]).candidates
    taken = {block.where for block in blocks if block.kind == "formula"}  # places of effects outside the library
    possible = [candidate for candidate in every if candidate.where not in taken]
    noise = projection.samples.variance(context.rig, projection.joint_jacobian)
    system = System(projection, blocks, _joined(possible, initial), noise / (noise + joint.fit.excess_variance))
    return system, tuple((own, 0, c.scale) for own, c in zip(initial, known, strict=True))


def _joined(possible: Sequence[CandidateEffect], known: Sequence[CandidateEffect]) -> list[CandidateEffect]:
    """Return the possible candidates; known ones get their known variant as the first option."""
    by_name = {str(c): c for c in known}
    out = []
    for candidate in possible:
        own = by_name.pop(str(candidate), None)
        if own is not None:
            options, additions = (*own.options, *candidate.options), (*own.additions, *candidate.additions)
            odds = np.append(candidate.log_odds.max(), candidate.log_odds)
            own = replace(candidate, options=options, additions=additions, log_odds=odds)
        out.append(candidate if own is None else own)
    return [*out, *by_name.values()]


def gains(
    system: System,
    model: Model,
    later: Collection[str] = (),
    any_size: bool = False,
) -> list[Gain]:
    """Return the gains of a model by the most promising candidates, greatest first.

    Args:
        system: the linear model.
        model: the present model.
        later: families to skip for now.
        any_size: True to include candidates whose estimates exceed their hard limits.
    """
    every = system.screen(model).score()
    possible = [w for w in promising(system, model, every, any_size=any_size) if w.candidate.family not in later]
    # Blocks that are negligible given the model stay so given a further effect. They may be half of all columns.
    small = system.negligible_blocks(model)
    found = [gain(system, model, w, model.scales, small) for w in possible[:_TRIED]]
    return sorted(found, key=lambda g: -g.log_odds)


def promising(
    system: System, model: Model, scored: Sequence[ScoredEffect], *, any_size: bool = False
) -> list[ScoredEffect]:
    """Return the scored candidates with a positive log Bayes factor, the most probable first.

    Args:
        system: the linear model.
        model: the model given which they were scored.
        scored: the candidates.
        any_size: True to include candidates whose estimates exceed their hard limits.
    """
    possible = [w for w in scored if w.log_bayes_factor > 0.0 and (any_size or not is_beyond_limits(system, model, w))]
    return sorted(possible, key=lambda w: -w.log_bayes_factor - log_prior(system, model, w.candidate))


def gain(system: System, model: Model, scored: ScoredEffect, start: Scales, without: Collection[str] = ()) -> Gain:
    """Return the gain of a model by a candidate, with all scales of the background refitted.

    Args:
        system: the linear model.
        model: the model without the candidate.
        scored: the candidate.
        start: initial scales.
        without: names of blocks to leave out.
    """
    tried = system.fit([*model.effects, system.choice(scored)], start, without=without, quick=True)
    best = tried.log_evidence - model.log_evidence
    log_bayes_factor = best + scored.form_averaging
    return Gain(scored, log_bayes_factor, best, log_bayes_factor + log_prior(system, model, scored.candidate), tried)


def temper(system: System, model: Model, candidate: CandidateEffect, log_bayes_factor: float) -> float:
    """Return the tempering factor by which variances are multiplied and log odds divided.

    A machine deviates from the equation of an effect, and a background fits this deviation imperfectly. Very large
    evidence is therefore trusted only in part. The degree of imperfection is estimated from the noise that station and
    readings do not explain.

    Args:
        system: the linear model.
        model: the model given which the evidence was computed.
        candidate: the effect.
        log_bayes_factor: the evidence.
    """
    unexplained = max(0.0, 1.0 - system.products.least_noise / model.scales.noise)
    differs = 2.0 * library()[candidate.family].shape_sigma ** 2 * log_bayes_factor
    return 1.0 + unexplained * (max(1.0, differs) - 1.0)


def is_beyond_limits(system: System, model: Model, scored: ScoredEffect) -> bool:
    """Return True if an estimate exceeds its hard limits by more than chance and an imperfect background explain.

    Args:
        system: the linear model.
        model: the model given which the candidate was scored.
        scored: the candidate.
    """
    error = scored.standard_error * math.sqrt(temper(system, model, scored.candidate, scored.log_bayes_factor))
    return bool(scored.choice.beyond_limits(system.projection.context, scored.estimate, error))


def log_prior(system: System, model: Model, candidate: CandidateEffect) -> float:
    """Return the log prior probability of a candidate; families already in the model share a probability of one half.

    If the curve of its own joint can imitate the candidate, its alternative is that curve instead of no effect.

    Args:
        system: the linear model.
        model: the model to which the candidate is added.
        candidate: the candidate.
    """
    if is_curve(system, candidate):
        return -math.log(sum(c.where == candidate.where and is_curve(system, c) for c in system.candidates))
    families = {c.family for c in system.candidates}
    places = sum(c.family == candidate.family for c in system.candidates)
    there = {system.candidates[number].family for number, _, _ in model.effects}
    if not there or there == families:
        return -math.log(len(families) * places)
    share = 0.5 / len(there) if candidate.family in there else 0.5 / (len(families) - len(there))
    return math.log(share / places)


def is_curve(system: System, candidate: CandidateEffect) -> bool:
    """Return True if the background's curve of the same joint can represent a candidate in these data."""
    curve = next((b for b in system.blocks.values() if b.kind == "curve" and b.where == candidate.where), None)
    own = candidate.additions[0]
    if curve is None or own.shift_mm is not None or candidate.family == MAP:
        return False
    basis = np.column_stack([np.ones(len(own.column)), curve.columns.column])
    left = own.column - basis @ np.linalg.lstsq(basis, own.column)[0]
    around = own.column - own.column.mean(axis=0)
    return bool((left**2).sum() < _LIKE_A_CURVE * (around**2).sum())


def needed(system: System, model: Model, candidate: CandidateEffect) -> float:
    """Return the log odds that a candidate needs to be added to a model.

    A new family needs the odds against no effect. Less is required for a further place of a family in the model, and
    against an anonymous curve of the joint.

    Args:
        system: the linear model.
        model: the model without the candidate.
        candidate: the candidate.
    """
    there = any(system.candidates[number].family == candidate.family for number, _, _ in model.effects)
    return ODDS_OF_TWO if there or is_curve(system, candidate) else ODDS


def add_certain_effects(system: System, model: Model, *, any_size: bool = False) -> Model:
    """Return a model to which the effect of greatest gain is added repeatedly until none is certain.

    A secondary effect (`Family.secondary_to`) can replace several effects of a primary family with one coefficient, and
    would be found instead of them. It is therefore considered only when no other effect is certain.

    Args:
        system: the linear model.
        model: the present model.
        any_size: True to add also effects whose estimates exceed their hard limits.
    """
    families = {c.family for c in system.candidates}
    for later in ({name for name in families if families & set(library()[name].secondary_to)}, set[str]()):
        while len(model.effects) < _MOST:
            every = gains(system, model, later=later, any_size=any_size)
            found = [g for g in every if g.log_odds > needed(system, model, g.scored.candidate)]
            if not found:
                break
            model = system.fit(found[0].model.effects, found[0].model.scales)
    return model
