"""Choice among candidate poses of those that determine a model best, or distinguish effects.

A pose gives the fixes of all prisms in view. They share the errors of the joint readings, so their covariance is
Sigma_station + J_q Sigma_q J_q', where the second part correlates them. The prior is given by the build tolerances, or
by a model's covariance. With such a prior, redundant parameters are harmless: no pose changes their covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.design.alternatives import (
    Alternative,
    alternative_of,
    changing,
    conditions_of,
    joined_columns,
    name_of,
)
from calibration.design.candidates import Candidates
from calibration.design.conditions import with_distinct_times
from calibration.design.exchange import (
    Accuracy,
    Criterion,
    Determinant,
    Discrimination,
    Hypothesis,
    Integers,
    choose,
    covariance_of,
    improve,
    information_of,
)
from calibration.design.knowledge import Knowledge
from calibration.design.tour import length_s, ordered, travel_s
from calibration.effects.columns import joined
from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect, coefficient_values, fitted_columns
from calibration.errors import DataError
from calibration.identification.identifiability import observability_indices
from calibration.identification.linear_model import information, prior_precision
from calibration.identification.noise import reading_variance, station_covariance
from calibration.identification.samples import averaged
from calibration.kinematics.chain import Linearisation
from calibration.numerics.matrices import root_of
from calibration.observations import Floats, Observations

_MOVES = 20  # exchange rounds with neighbours; twice as many would raise the log odds by about 1 %
_SEEN = 0.1  # as in identifiability: the data alone determine a direction within ten prior sigmas
_LINEARISED_AT_ONCE = 2000


@dataclass(frozen=True)
class Plan:
    """Poses to measure, ordered for short motion; for long motion where an effect in question grows with travel.

    Attributes:
        poses: the poses, the conditions that matter, and the prisms in view.
        seconds_of_motion: duration from the first to the last pose, with every joint at its full rate.
        parameters: number of parameters on which the set-up's fixes depend.
        determined: number of parameter directions that the poses alone determine.
        observability: `O1` .. `O5` of the poses alone.
        root: (p + k, p + k) root of the covariance of parameters and coefficients after the poses, root @ root'.
        stands_out: `family@where` of each effect to distinguish -> number of sigma by which it stands out from the best
            explanation by the most similar other effect, at its plausible or fitted size. Half the square is the log
            odds that the poses are expected to bring, if the effect exists.
    """

    poses: Candidates
    seconds_of_motion: float
    parameters: int
    determined: int
    observability: dict[str, float]
    root: Floats
    stands_out: dict[str, float]


def plan(
    knowledge: Knowledge,
    candidates: Candidates,
    count: int,
    *,
    volume: Floats | None = None,
    separate: Sequence[str | Sequence[FittedEffect]] = (),
    measured: Observations | None = None,
    nearby: Callable[[Candidates], tuple[Candidates, Integers]] | None = None,
) -> Plan:
    """Choose poses among candidates.

    Args:
        knowledge: knowledge of the rig.
        candidates: at least `count` candidate poses.
        count: number of poses.
        volume: (v, joints) poses of the work volume. If given, optimise the accuracy of predictions there (V-optimal)
            instead of the parameters (D-optimal).
        separate: effects to distinguish, assuming that one of them exists and none is in the knowledge. Each is either
            the `family@where` of an effect in the library, at its plausible size, or a sequence of a fitted effect
            followed by others that count as the same answer.
        measured: rows that were measured already but are not part of `knowledge`.
        nearby: `near` with all arguments bound but the poses. If given, the chosen poses move repeatedly to better
            neighbours.

    Raises:
        DataError: fewer candidates than poses; an effect that is not visible in any pose.
    """
    if len(candidates) < count:
        raise DataError("poses", f"only {len(candidates)} reachable poses in view were found, {count} are requested")
    rig = knowledge.chain.rig
    answers: list[Sequence[str | FittedEffect]] = [[one] if isinstance(one, str) else one for one in separate]
    effects = [effect for answer in answers for effect in answer]
    before = knowledge.without([name_of(effect) for effect in effects])
    known = len(before.root)
    candidates = _under_conditions_that_matter(knowledge, before, candidates, effects)
    with threadpool_limits(1, user_api="blas"):  # the blocks are small: threads would wait for each other
        alternatives = tuple(alternative_of(before, e, candidates.readings, candidates.conditions) for e in effects)
        known_information = None if measured is None else _measured_information(before, measured, alternatives)
        blocks = whitened(before, candidates, alternatives)
        criterion: Criterion = Determinant()
        if alternatives:
            nothing = information_of(blocks[:0], known_information)
            pairs = _pairs([len(answer) for answer in answers])
            hypotheses = _hypotheses(known, alternatives, nothing)
            criterion = Discrimination(hypotheses if len(answers) == 1 else hypotheses[:-1], nothing, pairs)
        elif volume is not None:
            criterion = Accuracy(volume_root(knowledge, volume))
        in_view = np.repeat(candidates.seen.any(axis=0), 3)
        chosen = candidates.select(choose(blocks[:, in_view], count, criterion, known_information))
        if nearby is not None:
            for _ in range(_MOVES):
                closer, number = nearby(chosen)
                chosen = closer.select(
                    improve(whitened(before, closer, alternatives)[:, in_view], number, criterion, known_information)
                )
        seconds = travel_s(rig, chosen.readings)
        order = ordered(rig, seconds, chosen, [name_of(effect) for effect in effects])
        poses = chosen.select(order)
        poses = replace(poses, conditions=with_distinct_times(poses.conditions))
        stands_out: dict[str, float] = {}
        if isinstance(criterion, Discrimination):
            # Recomputed in the final order, as some effects depend on the preceding poses.
            log_odds = criterion.log_odds(information_of(whitened(before, poses, alternatives), known_information))
            stands_out = _stands_out(alternatives, criterion.pairs, log_odds)
        after = covariance_of(whitened(knowledge, poses))
        alone = _alone(knowledge, poses)
    seen = alone[alone > _SEEN]
    return Plan(
        poses,
        length_s(seconds, order),
        knowledge.parameters,
        len(seen),
        observability_indices(seen, poses.fixes_in_all),
        knowledge.root @ root_of(after),
        stands_out,
    )


def _under_conditions_that_matter(
    knowledge: Knowledge, before: Knowledge, candidates: Candidates, separate: Sequence[str | FittedEffect]
) -> Candidates:
    """Keep the conditions that matter.

    These are the conditions that the effects to distinguish need as inputs, held constant where they change none of the
    effects; and the conditions that change some of the effects but not all.
    """
    matters = _sides(knowledge, candidates)
    if not separate:
        return candidates.under(matters)
    few = candidates.few()
    needed = {c for e in separate for c in conditions_of(before, name_of(e), few.readings, few.conditions)}
    changes = changing(before, separate, few.readings, few.conditions)
    idle = needed.intersection(name for kind, names in changes.items() if not names for name in kind)
    telling = {name for kind, names in changes.items() if 0 < len(names) < len(separate) for name in kind}
    held = {
        name: np.full(len(candidates), values.min()) for name, values in candidates.conditions.items() if name in idle
    }
    kept = replace(candidates, conditions={**candidates.conditions, **held})
    return kept.under(matters | needed | telling | {"fixes"})


def _pairs(members: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Pair the first member of every answer with all members of the other answers.

    A single answer is paired with the hypothesis of no effect, which comes last.
    """
    first = [sum(members[:number]) for number in range(len(members))]
    if len(members) == 1:
        return ((0, members[0]), (members[0], 0))
    return tuple(
        (one, other + k)
        for one in first
        for other, size in zip(first, members, strict=True)
        for k in range(size)
        if other != one
    )


def _stands_out(
    alternatives: Sequence[Alternative], pairs: Sequence[tuple[int, int]], log_odds: Floats
) -> dict[str, float]:
    """Return effect name -> the number of sigma by which it stands out from the most similar other effect."""
    least: dict[int, float] = {}
    for odds, (true, _) in zip(log_odds.tolist(), pairs, strict=True):
        least[true] = min(odds, least.get(true, math.inf))
    # The hypothesis of no effect comes last and has no name.
    named = {alternatives[true].name: odds for true, odds in least.items() if true < len(alternatives)}
    return {name: math.sqrt(2.0 * max(0.0, odds)) for name, odds in named.items()}


def _hypotheses(known: int, alternatives: Sequence[Alternative], before: Floats) -> tuple[Hypothesis, ...]:
    """Return a hypothesis for each effect together with the kinematics, and last one for the kinematics alone.

    Args:
        known: number of parameters and coefficients without those of the alternatives.
        alternatives: the effects.
        before: (q, q) information of the prior and of earlier measurements.
    """
    kinematics, found = np.arange(known), list[Hypothesis]()
    first = known
    for alternative in alternatives:
        own = first + np.arange(alternative.size)
        first += alternative.size
        mean = np.zeros(len(before))
        mean[own] = alternative.found
        # Given the effect, the kinematics explain the rest of the measurements.
        mean[:known] = -np.linalg.solve(before[:known, :known], before[:known, own] @ alternative.found)
        found.append(Hypothesis(mean, np.concatenate([kinematics, own])))
    return (*found, Hypothesis(np.zeros(len(before)), kinematics))


def whitened(knowledge: Knowledge, candidates: Candidates, alternatives: tuple[Alternative, ...] = ()) -> Floats:
    """(n, 3 prisms, p + k) whitened Jacobian of each pose's fixes, with parameters in prior units.

    Rows of prisms out of view are zero.

    Args:
        knowledge: linearisation point and prior covariance.
        candidates: n poses.
        alternatives: effects whose coefficients are the last columns.
    """
    prisms, known = len(knowledge.chain.rig.prisms), len(knowledge.root)
    # For all poses at once, as an effect in one pose may depend on the preceding ones.
    columns = joined_columns(alternatives, knowledge.context(candidates.readings, candidates.conditions))
    total = known + len(columns)
    out = np.empty((len(candidates), 3 * prisms, total))
    for first in range(0, len(candidates), _LINEARISED_AT_ONCE):
        rows = np.arange(first, min(first + _LINEARISED_AT_ONCE, len(candidates)))
        some, n = candidates.select(rows), len(rows)
        lin = knowledge.linearise(some.readings, some.conditions)
        covariance = _noise(knowledge, lin, some)
        hidden = np.repeat(~some.seen, 3, axis=1)
        covariance[hidden[:, :, None] | hidden[:, None, :]] = 0.0
        covariance[hidden[:, :, None] & np.eye(3 * prisms, dtype=bool)] = 1.0
        jacobian = np.empty((n * prisms, 3, total))
        jacobian[:, :, :known] = lin.jacobian @ knowledge.root
        fixes = np.arange(prisms * rows[0], prisms * (rows[-1] + 1))
        jacobian[:, :, known:] = columns.select(fixes).moved_mm(lin.joint_jacobian)
        stacked = jacobian.reshape(n, 3 * prisms, total)
        stacked[hidden] = 0.0
        out[rows] = np.linalg.solve(np.linalg.cholesky(covariance), stacked)
    return out


def volume_root(knowledge: Knowledge, volume: Floats) -> Floats:
    """(p + k, r) root of the mean of J'J over poses (v, joints) and all prisms, the parameters in prior units."""
    jacobian = knowledge.linearise(volume).jacobian
    rows = (jacobian @ knowledge.root).reshape(-1, len(knowledge.root)) / np.sqrt(len(jacobian))
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64).T


def _noise(knowledge: Knowledge, lin: Linearisation, poses: Candidates) -> Floats:
    """(n, 3 prisms, 3 prisms) covariance of the fixes of each standstill.

    The errors of the readings and the unknown part of the joint values are common to the fixes of a pose. In motion,
    every fix has its own timing error in addition.
    """
    rig, n = knowledge.chain.rig, len(poses)
    size = 3 * len(rig.prisms)
    unknown = knowledge.unknown_variance(poses.readings, poses.conditions)
    common = (lin.joint_jacobian * np.sqrt(reading_variance(rig) + unknown)[:, None, :]).reshape(n, size, -1)
    covariance: Floats = common @ common.transpose(0, 2, 1)
    own = station_covariance(rig, lin.position_mm, np.full(lin.position_mm.shape, np.nan))
    own /= np.repeat(poses.fixes, len(rig.prisms))[:, None, None]
    even = knowledge.excess_variance + knowledge.unknown_mm2(poses.readings, poses.conditions)
    own = own + even[:, None, None] * np.eye(3)
    still = np.zeros(n)
    rates = np.column_stack([poses.conditions.get(f"{name}_rate", still) for name in rig.joint_names])
    if rates.any():
        velocity = lin.joint_jacobian @ np.repeat(rates, len(rig.prisms), axis=0)[:, :, None]
        own = own + rig.station.timing_sigma_s**2 * velocity @ velocity.transpose(0, 2, 1)
    own = own.reshape(n, -1, 3, 3)
    for prism in range(len(rig.prisms)):
        block = slice(3 * prism, 3 * prism + 3)
        covariance[:, block, block] += own[:, prism]
    return covariance


def _alone(knowledge: Knowledge, poses: Candidates) -> Floats:
    """Return the singular values of the poses' whitened Jacobian, with parameters in units of build tolerance."""
    sigma = np.diag(prior_precision(knowledge.chain, 1.0) ** -0.5)
    rows = whitened(replace(knowledge, root=sigma, effects=()), poses)
    return np.asarray(np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False), dtype=np.float64)


def _measured_information(
    knowledge: Knowledge, measured: Observations, alternatives: tuple[Alternative, ...]
) -> Floats:
    """(q, q) information of measured rows about parameters and coefficients, in prior units."""
    chain = knowledge.chain
    samples = averaged(chain, measured)
    context = EffectContext(chain, knowledge.x, measured)
    parts = [fitted_columns(knowledge.effects, context), joined_columns(alternatives, context)]
    additions = joined(parts, len(measured)).over(samples.average)
    known, total = len(knowledge.root), len(chain) + len(additions)
    x = np.zeros(total)
    x[:known] = np.concatenate([knowledge.x, coefficient_values(knowledge.effects)])
    root = np.eye(total)
    root[:known, :known] = knowledge.root
    added = information(chain, samples, x, excess_variance=knowledge.excess_variance, additions=additions)
    in_units: Floats = root.T @ added @ root
    return in_units


def _sides(knowledge: Knowledge, candidates: Candidates) -> set[str]:
    """Return the directions of approach that effects of the model need as inputs."""
    joints = knowledge.chain.rig.joint_names
    poses = candidates.select(np.arange(1)).under([f"{name}_dir" for name in joints])
    without = knowledge.unknown_variance(poses.readings)[0]
    given = knowledge.unknown_variance(poses.readings, poses.conditions)[0]
    return {f"{name}_dir" for name, more, less in zip(joints, without, given, strict=True) if more > less}
