"""The search for effects beside a background: the one of greatest gain is added until none is beyond doubt."""

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

MAP = "joint_error_map"  # the curves of the background are this effect
ODDS = math.log(999.0)  # of an effect against none
ODDS_OF_TWO = math.log(19.0)  # of one effect against another that is as likely beforehand
_LIKE_A_CURVE = 0.02  # share of the variance that a curve may leave
_TRIED = 6  # candidates whose gain is found with scales of their own
_MOST = 60  # effects
_PASSES = 4


@dataclass(frozen=True)
class Gain:
    """A candidate, and what a model gains by it.

    Attributes:
        scored: the candidate.
        log_bayes_factor: against the model without it, all scales of the background found again.
        log_likelihood_gain: the same of its best form and size, as if these had been known beforehand.
        log_odds: `log_bayes_factor` with prior odds.
        model: with it.
    """

    scored: ScoredEffect
    log_bayes_factor: float
    log_likelihood_gain: float
    log_odds: float
    model: Model


def search_beside(
    problem: Problem,
    joint: JointFit,
    blocks: Sequence[Block],
    families: Collection[str],
    known: Sequence[Choice],
    possible: PossibleBlocks | None = None,
) -> tuple[System, Model]:
    """Return the linear model with all effects that are beyond doubt beside a background.

    Outliers and scatter are judged again beside what was found, and the search goes on from there. An effect takes on
    what others explain that are not found yet, so its estimate may be beyond its hard limits until they are: the
    judgement of effects looks at limits, not the search.

    Args:
        problem: the data.
        joint: the kinematics alone, with weights to begin with.
        blocks: of the background.
        families: of effects that may be named.
        known: effects to begin with.
        possible: yields blocks to widen the background by where the errors ask for them; None for none.
    """
    scales: Scales | None = None
    found: tuple[Effect, ...] = ()
    for number in range(_PASSES):
        fit, scales = reweighted(problem, joint, blocks, found, scales)
        joint = replace(joint, fit=fit)
        system, begun = linear_system(problem, joint, blocks, families, known)
        effects = found if number else begun
        model = grown(system, system.fit(system.chosen(effects), scales), any_size=True)
        found = tuple((system.candidates[n], option, scale) for n, option, scale in model.effects)
        scales = model.scales
        further = further_blocks(system, model, possible) if possible else ()
        if number and len(found) == len(effects) and not further:
            break
        blocks = [*blocks, *further]
    return system, model


def background_log_bayes_factor(problem: Problem, joint: JointFit, blocks: Sequence[Block]) -> float:
    """Return the log Bayes factor of a background beside kinematics and effects, against noise alone.

    Args:
        problem: the data.
        joint: kinematics and effects.
        blocks: of the background.
    """
    system, effects, scales = system_beside(problem, blocks, joint.choices)
    return system.background_log_bayes_factor(system.fit(effects, scales))


def system_beside(
    problem: Problem, blocks: Sequence[Block], known: Sequence[Choice]
) -> tuple[System, list[Chosen], Scales]:
    """Return the linear model with known effects beside a background, by weights that count beside all of these.

    Args:
        problem: the data.
        blocks: of the background.
        known: effects.

    Returns:
        The model, the effects in it, in their order, and the scales of the background beside them.
    """
    joint, scales = joint_beside(problem, blocks, known)
    system, effects = linear_system(problem, joint, blocks, (), known)
    return system, system.chosen(effects), scales


def joint_beside(problem: Problem, blocks: Sequence[Block], known: Sequence[Choice]) -> tuple[JointFit, Scales]:
    """Return the kinematics alone by weights that count beside known effects and a background, and its scales.

    Arguments are those of `system_beside`.
    """
    kinematics = problem.with_mild_outliers(problem.kinematics_only())
    _, effects = linear_system(problem, kinematics, (), (), known)
    fit, scales = reweighted(problem, kinematics, blocks, effects, None)
    return replace(kinematics, fit=fit), scales


def linear_system(
    problem: Problem, joint: JointFit, blocks: Sequence[Block], families: Collection[str], known: Sequence[Choice]
) -> tuple[System, tuple[Effect, ...]]:
    """Return the linear model about a fit, and the known effects in it.

    Args:
        problem: the data.
        joint: the kinematics alone, with weights and scatter that count.
        blocks: of a background.
        families: of the candidates; new maps of joints are the background's.
        known: effects that are candidates in any case, in the form that they are known in.
    """
    projection, context = problem.project(joint), joint.situation
    begun = [candidate_at(context, projection, c.family, c.where, [replace(c, scale=1.0)]) for c in known]
    every = candidate_effects(context, projection, [name for name in families if name != MAP]).candidates
    taken = {block.where for block in blocks if block.kind == "formula"}  # what is outside the library is there
    possible = [candidate for candidate in every if candidate.where not in taken]
    noise = projection.samples.variance(context.rig, projection.joint_jacobian)
    system = System(projection, blocks, _joined(possible, begun), noise / (noise + joint.fit.excess_variance))
    return system, tuple((own, 0, c.scale) for own, c in zip(begun, known, strict=True))


def _joined(possible: Sequence[CandidateEffect], known: Sequence[CandidateEffect]) -> list[CandidateEffect]:
    """Return the possible candidates, those that are known with the form that they are known in as their first."""
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
    """Return what a model gains by the candidates that promise most, the greatest first.

    Args:
        system: the linear model.
        model: what is there.
        later: families whose turn has not come.
        any_size: candidates whose estimates are beyond their hard limits are among them.
    """
    every = system.screen(model).score()
    possible = [w for w in promising(system, model, every, any_size=any_size) if w.candidate.family not in later]
    # What is small beside the model stays so beside a further effect, and half of all columns may be of that.
    small = system.negligible_blocks(model)
    found = [gain(system, model, w, model.scales, small) for w in possible[:_TRIED]]
    return sorted(found, key=lambda g: -g.log_odds)


def promising(
    system: System, model: Model, scored: Sequence[ScoredEffect], *, any_size: bool = False
) -> list[ScoredEffect]:
    """Return the scored candidates that speak for themselves, the most probable first.

    Args:
        system: the linear model.
        model: beside which they were scored.
        scored: candidates.
        any_size: those whose estimates are beyond their hard limits are among them.
    """
    possible = [w for w in scored if w.log_bayes_factor > 0.0 and (any_size or not is_beyond_limits(system, model, w))]
    return sorted(possible, key=lambda w: -w.log_bayes_factor - log_prior(system, model, w.candidate))


def gain(system: System, model: Model, scored: ScoredEffect, start: Scales, without: Collection[str] = ()) -> Gain:
    """Return what a model gains by a candidate, all scales of the background found again.

    Args:
        system: the linear model.
        model: without the candidate.
        scored: the candidate.
        start: scales to start from.
        without: names of blocks that the model is to do without.
    """
    tried = system.fit([*model.effects, system.choice(scored)], start, without=without, quick=True)
    best = tried.log_evidence - model.log_evidence
    log_bayes_factor = best + scored.form_averaging
    return Gain(scored, log_bayes_factor, best, log_bayes_factor + log_prior(system, model, scored.candidate), tried)


def temper(system: System, model: Model, candidate: CandidateEffect, log_bayes_factor: float) -> float:
    """Return the factor by which variances are larger, and log odds less, than a model says.

    A machine does not do quite what the equation of an effect says, and a background fits it imperfectly: evidence that
    is larger than the part that may differ can count is true to a share of it only. How imperfect it all is shows in
    the noise, as far as station and readings do not account for that.

    Args:
        system: the linear model.
        model: beside which the evidence was taken.
        candidate: the effect.
        log_bayes_factor: the evidence.
    """
    unexplained = max(0.0, 1.0 - system.products.least_noise / model.scales.noise)
    differs = 2.0 * library()[candidate.family].shape_sigma ** 2 * log_bayes_factor
    return 1.0 + unexplained * (max(1.0, differs) - 1.0)


def is_beyond_limits(system: System, model: Model, scored: ScoredEffect) -> bool:
    """True if an estimate is beyond its hard limits by more than chance and an imperfect background account for."""
    error = scored.standard_error * math.sqrt(temper(system, model, scored.candidate, scored.log_bayes_factor))
    return bool(scored.choice.beyond(system.projection.situation, scored.estimate, error))


def log_prior(system: System, model: Model, candidate: CandidateEffect) -> float:
    """Return the log prior probability of a candidate; families that a model has share half of it all.

    One that the curve of its own joint can imitate has that curve for its alternative, and not nothing.
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
    """True if the background's curve of the same joint can do what a candidate does in these data."""
    curve = next((b for b in system.blocks.values() if b.kind == "curve" and b.where == candidate.where), None)
    own = candidate.additions[0]
    if curve is None or own.shift_mm is not None or candidate.family == MAP:
        return False
    basis = np.column_stack([np.ones(len(own.column)), curve.columns.column])
    left = own.column - basis @ np.linalg.lstsq(basis, own.column)[0]
    around = own.column - own.column.mean(axis=0)
    return bool((left**2).sum() < _LIKE_A_CURVE * (around**2).sum())


def needed(system: System, model: Model, candidate: CandidateEffect) -> float:
    """Return the log odds that a candidate needs in addition to a model.

    They are those against nothing for a new family; less is enough for a further place of a family that is there, and
    against an anonymous curve of the joint.
    """
    there = any(system.candidates[number].family == candidate.family for number, _, _ in model.effects)
    return ODDS_OF_TWO if there or is_curve(system, candidate) else ODDS


def grown(system: System, model: Model, *, any_size: bool = False) -> Model:
    """Return a model with the effect of the greatest gain added until none is beyond doubt.

    One coefficient of an effect that comes after another can stand for several of that one, and would be taken for it:
    it has its turn when none of the others is beyond doubt any more.

    Args:
        system: the linear model.
        model: what is there.
        any_size: effects whose estimates are beyond their hard limits are added too.
    """
    families = {c.family for c in system.candidates}
    for later in ({name for name in families if families & set(library()[name].comes_after)}, set[str]()):
        while len(model.effects) < _MOST:
            every = gains(system, model, later=later, any_size=any_size)
            found = [g for g in every if g.log_odds > needed(system, model, g.scored.candidate)]
            if not found:
                break
            model = system.fit(found[0].model.effects, found[0].model.scales)
    return model
