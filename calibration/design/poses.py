"""Poses that determine a model best: drawn inside the joint limits, in view of the station, chosen by exchange.

A pose brings the fixes of all prisms in view. They share the errors of the joints' readings, so their covariance is
Sigma_station + J_q Sigma_q J_q' with the second part common to them; what is known beforehand are the build tolerances,
or a model's covariance. With such a prior a redundant parameter is no obstacle: no pose changes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.design.conditions import Conditions, drawn, one_after_another, slow, under
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
from calibration.design.rivals import Rival, changing, conditions_of, name_of, rival_of, together
from calibration.design.tour import length_s, short_tour, travel_s
from calibration.design.visibility import Bodies, Flags, Site, in_view, is_reachable, limits
from calibration.effects.base import Situation
from calibration.effects.fitted import FittedEffect, coefficient_values, fitted_additions
from calibration.effects.library import library
from calibration.errors import DataError, UnsafeError
from calibration.identification.additions import Additions, joined
from calibration.identification.identifiability import observability_indices
from calibration.identification.refinement import information, prior_precision
from calibration.identification.samples import averaged, reading_variance, station_covariance
from calibration.kernels.machine import root_of
from calibration.kinematics import Linearisation
from calibration.observations import Floats, Observations
from calibration.rig import Rig

CANDIDATES = 10_000
_BATCHES = 10
_MARGIN = 0.01  # of a joint's range, kept from its limits
_NEAR = 100  # to each pose
_MOVES = 20  # of each pose; as many again would bring a hundredth more of the log odds
_WIDTHS = 0.02, 0.2  # of a joint's range, 1 sigma
_SEEN = 0.1  # as in identifiability: the data alone determine a direction within ten prior sigmas
_TRIED = 64  # poses in which conditions are tried
_LINEARISED_AT_ONCE = 2000


@dataclass(frozen=True)
class Candidates:
    """Poses that the rig can take.

    Attributes:
        readings: (n, joints) deg or mm.
        conditions: under which each is to be measured.
        seen: (n, prisms) prisms in view.
    """

    readings: Floats
    conditions: Conditions
    seen: Flags

    def __len__(self) -> int:
        return len(self.readings)

    @property
    def fixes(self) -> Floats:
        """(n,) how many are taken of each prism in view."""
        return self.conditions.get("fixes", np.ones(len(self)))

    @property
    def fixes_in_all(self) -> int:
        """Of all prisms in all poses."""
        return int(self.fixes @ self.seen.sum(axis=1))

    def few(self) -> Candidates:
        """Enough of them to try in which conditions what shows."""
        return self.select(np.arange(min(_TRIED, len(self))))

    def select(self, which: Integers) -> Candidates:
        """The given poses."""
        conditions = {name: values[which] for name, values in self.conditions.items()}
        return Candidates(self.readings[which], conditions, self.seen[which])

    def under(self, names: Collection[str]) -> Candidates:
        """The same poses, with nothing said of other conditions."""
        return replace(self, conditions=under(self.conditions, names))


@dataclass(frozen=True)
class Plan:
    """Poses to measure, in the order of a short motion; of a long one where an effect in question grows with travel.

    Attributes:
        poses: what to drive to, under which conditions where these matter, and what is in view there.
        seconds_of_motion: from the first to the last, every joint at its full rate.
        parameters, determined: how many the set-up can show, and how many directions of them the poses alone determine.
        observability: `O1` .. `O5` of the poses alone.
        root: (p + k, p + k) covariance of parameters and coefficients after the poses = root @ root'.
        stands_out: `family@where` of the effects to be told apart -> by how many sigma one of plausible size, or of the
            size found, stands out in these poses from what the most alike of the others can explain: half the square
            are the log odds that they are expected to bring, if it is there.
    """

    poses: Candidates
    seconds_of_motion: float
    parameters: int
    determined: int
    observability: dict[str, float]
    root: Floats
    stands_out: dict[str, float]


def draw(
    knowledge: Knowledge,
    at: Site,
    rng: np.random.Generator,
    count: int = CANDIDATES,
    *,
    begin_s: float = 0.0,
    payload_kg: float = 0.0,
) -> Candidates:
    """Random poses that the rig can take and in which the station sees a prism.

    Half of them are drawn evenly between the joint limits, half lean to the limits (arcsine law), where errors show
    most.

    Args:
        knowledge: of the rig.
        at: what stands around it.
        rng: draws.
        count: how many poses.
        begin_s: `time_s` at which they can be measured, at the earliest.
        payload_kg: as for `conditions.drawn`.

    Raises:
        UnsafeError: there is none.
    """
    chain = knowledge.chain
    low, high = limits(chain.rig)
    margin = _MARGIN * (high - low)
    readings, seen = np.empty((0, len(low))), np.empty((0, len(chain.rig.prisms)), dtype=bool)
    for _ in range(_BATCHES):
        share = rng.random((count, len(low)))
        share[::2] = np.sin(0.5 * np.pi * share[::2]) ** 2
        tried = low + margin + (high - low - 2.0 * margin) * share
        bodies = Bodies.of(chain, knowledge.x, tried)
        view = in_view(bodies, at)
        good = is_reachable(bodies, at) & view.any(axis=1)
        readings, seen = np.concatenate([readings, tried[good]]), np.concatenate([seen, view[good]])
        if len(readings) >= count:
            break
    if len(readings) == 0:
        raise UnsafeError(
            f"of {_BATCHES * count} poses inside the joint limits of rig {chain.rig.name!r} none is reachable with a "
            f"prism in view of the station at {', '.join(f'{c:.0f}' for c in at.station_mm)} mm in the base frame; "
            f"check the station's place and the floor"
        )
    readings, seen = readings[:count], seen[:count]
    conditions = drawn(chain.rig, len(readings), rng, begin_s=begin_s, payload_kg=payload_kg)
    return Candidates(readings, conditions, seen)


def near(knowledge: Knowledge, at: Site, rng: np.random.Generator, poses: Candidates) -> tuple[Candidates, Integers]:
    """These poses, and random ones that differ little from each in some of the joints, under the same conditions.

    Only such as the rig can take and in which the station sees all that it sees in the one they are near, whose number
    comes with each; the pose itself is the first of them.
    """
    low, high = limits(knowledge.chain.rig)
    margin = _MARGIN * (high - low)
    number = np.repeat(np.arange(len(poses)), _NEAR)
    about = poses.select(number)
    width = np.tile(np.geomspace(*_WIDTHS, _NEAR), len(poses))[:, None]
    moved = width * rng.standard_normal(about.readings.shape) * (rng.random(about.readings.shape) < 0.5)
    moved[::_NEAR] = 0.0
    tried = np.clip(about.readings + (high - low) * moved, low + margin, high - margin)
    bodies = Bodies.of(knowledge.chain, knowledge.x, tried)
    good = np.flatnonzero(is_reachable(bodies, at) & (in_view(bodies, at) >= about.seen).all(axis=1))
    return replace(about, readings=tried).select(good), number[good]


def work_volume(knowledge: Knowledge, at: Site, rng: np.random.Generator, count: int) -> Floats:
    """(count, joints) poses drawn evenly among those that the rig can take, in view or not.

    Raises:
        UnsafeError: there is none.
    """
    low, high = limits(knowledge.chain.rig)
    found = np.empty((0, len(low)))
    for _ in range(_BATCHES):
        drawn = rng.uniform(low, high, (count, len(low)))
        found = np.concatenate([found, drawn[is_reachable(Bodies.of(knowledge.chain, knowledge.x, drawn), at)]])
        if len(found) >= count:
            return found[:count]
    if len(found) == 0:
        raise UnsafeError(
            f"rig {knowledge.chain.rig.name!r} can take none of {_BATCHES * count} poses inside its joint limits "
            f"without touching itself or the floor at {at.floor_mm:.0f} mm; check the floor"
        )
    return found


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
    """Choose poses.

    Args:
        knowledge: of the rig.
        candidates: at least `count` of them.
        count: how many poses.
        volume: (v, joints) poses of the work volume: choose for the accuracy of predictions there (V-optimal) and not
            for the parameters (D-optimal).
        separate: effects, each the `family@where` of one in the library, of plausible size, or one as it was found, and
            after it others that would be the same answer: choose to tell each from the others, one of them being there
            and none known yet.
        measured: rows that were measured already and are no part of what is known.
        nearby: as `near` without its first arguments; the poses chosen move to better ones near them, time and again.

    Raises:
        DataError: fewer candidates than poses; an effect that no choice of poses shows.
    """
    if len(candidates) < count:
        raise DataError("poses", f"only {len(candidates)} reachable poses in view were found, {count} are asked for")
    rig = knowledge.chain.rig
    answers: list[Sequence[str | FittedEffect]] = [[one] if isinstance(one, str) else one for one in separate]
    effects = [effect for answer in answers for effect in answer]
    before = knowledge.without([name_of(effect) for effect in effects])
    known = len(before.root)
    candidates = _as_they_matter(knowledge, before, candidates, effects)
    with threadpool_limits(1, user_api="blas"):  # the blocks are small: threads would wait for each other
        rivals = tuple(rival_of(before, e, candidates.readings, candidates.conditions) for e in effects)
        told = None if measured is None else _told(before, measured, rivals)
        blocks = whitened(before, candidates, rivals)
        criterion: Criterion = Determinant()
        if rivals:
            nothing = information_of(blocks[:0], told)
            pairs = _pairs([len(answer) for answer in answers])
            hypotheses = _hypotheses(known, rivals, nothing)
            criterion = Discrimination(hypotheses if len(answers) == 1 else hypotheses[:-1], nothing, pairs)
        elif volume is not None:
            criterion = Accuracy(volume_root(knowledge, volume))
        in_view = np.repeat(candidates.seen.any(axis=0), 3)
        chosen = candidates.select(choose(blocks[:, in_view], count, criterion, told))
        if nearby is not None:
            for _ in range(_MOVES):
                closer, number = nearby(chosen)
                chosen = closer.select(improve(whitened(before, closer, rivals)[:, in_view], number, criterion, told))
        seconds = travel_s(rig, chosen.readings)
        order = _order(rig, seconds, chosen, [name_of(effect) for effect in effects])
        poses = chosen.select(order)
        poses = replace(poses, conditions=one_after_another(poses.conditions))
        stands_out: dict[str, float] = {}
        if isinstance(criterion, Discrimination):
            # Once more in their order: some effects depend on what was before.
            log_odds = criterion.log_odds(information_of(whitened(before, poses, rivals), told))
            least: dict[int, float] = {}
            for odds, (true, _) in zip(log_odds.tolist(), pairs, strict=True):
                least[true] = min(odds, least.get(true, math.inf))
            for true, odds in least.items():
                if true < len(rivals):  # nothing at all is told apart, too, and has no name
                    stands_out[rivals[true].name] = math.sqrt(2.0 * max(0.0, odds))
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


def _as_they_matter(
    knowledge: Knowledge, before: Knowledge, candidates: Candidates, separate: Sequence[str | FittedEffect]
) -> Candidates:
    """The same poses under the conditions that matter.

    Those that effects to be told apart need, varied only where that changes any of them, and those that change some of
    them and leave others.
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
    """Of answers with so many members each, the first of every one, and all of the others that it is to be told from.

    One answer is to be told from none at all, which comes last.
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


def _hypotheses(known: int, rivals: Sequence[Rival], before: Floats) -> tuple[Hypothesis, ...]:
    """Each effect by itself beside the kinematics, and last the kinematics alone.

    Args:
        known: how many parameters and coefficients there are beside those of the rivals.
        rivals: the effects.
        before: (q, q) information of the prior and of what was measured already.
    """
    kinematics, found = np.arange(known), list[Hypothesis]()
    first = known
    for rival in rivals:
        own = first + np.arange(rival.size)
        first += rival.size
        mean = np.zeros(len(before))
        mean[own] = rival.found
        # Beside it, the kinematics explain the rest of what was measured.
        mean[:known] = -np.linalg.solve(before[:known, :known], before[:known, own] @ rival.found)
        found.append(Hypothesis(mean, np.concatenate([kinematics, own])))
    return (*found, Hypothesis(np.zeros(len(before)), kinematics))


def whitened(knowledge: Knowledge, candidates: Candidates, rivals: tuple[Rival, ...] = ()) -> Floats:
    """(n, 3 prisms, p + k) Jacobian of each pose's fixes in their sigmas, the parameters in prior units.

    Rows of prisms out of view are zero. The coefficients of `rivals` come last.
    """
    prisms, known = len(knowledge.chain.rig.prisms), len(knowledge.root)
    columns: Additions | None = None
    if rivals:  # of all poses at once: what an effect does may depend on those before
        columns = together(rivals, knowledge.situation(candidates.readings, candidates.conditions))
    total = known + (0 if columns is None else len(columns))
    out = np.empty((len(candidates), 3 * prisms, total))
    for first in range(0, len(candidates), _LINEARISED_AT_ONCE):
        rows = np.arange(first, min(first + _LINEARISED_AT_ONCE, len(candidates)))
        some, n = candidates.select(rows), len(rows)
        lin, by_known = knowledge.linearise(some.readings, some.conditions)
        covariance = _noise(knowledge, lin, some)
        hidden = np.repeat(~some.seen, 3, axis=1)
        covariance[hidden[:, :, None] | hidden[:, None, :]] = 0.0
        covariance[hidden[:, :, None] & np.eye(3 * prisms, dtype=bool)] = 1.0
        jacobian = np.empty((n * prisms, 3, total))
        jacobian[:, :, :known] = by_known @ knowledge.root
        if columns is not None:
            fixes = np.arange(prisms * rows[0], prisms * (rows[-1] + 1))
            jacobian[:, :, known:] = columns.select(fixes).moved_mm(lin.joint_jacobian)
        stacked = jacobian.reshape(n, 3 * prisms, total)
        stacked[hidden] = 0.0
        out[rows] = np.linalg.solve(np.linalg.cholesky(covariance), stacked)
    return out


def volume_root(knowledge: Knowledge, volume: Floats) -> Floats:
    """(p + k, r) root of the mean of J'J over poses (v, joints) and all prisms, the parameters in prior units."""
    _, jacobian = knowledge.linearise(volume)
    rows = (jacobian @ knowledge.root).reshape(-1, len(knowledge.root)) / np.sqrt(len(jacobian))
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64).T


def _noise(knowledge: Knowledge, lin: Linearisation, poses: Candidates) -> Floats:
    """(n, 3 prisms, 3 prisms) covariance of the fixes of each standstill; the readings' errors are common to them.

    So is what is unknown of the joints' values. On the move, every fix has its own error of the instant.
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
    """Singular values of what the poses alone say, each parameter in units of its build tolerance."""
    sigma = np.diag(prior_precision(knowledge.chain, 1.0) ** -0.5)
    rows = whitened(replace(knowledge, root=sigma, effects=()), poses)
    return np.asarray(np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False), dtype=np.float64)


def _told(knowledge: Knowledge, measured: Observations, rivals: tuple[Rival, ...]) -> Floats:
    """(q, q) what rows that were measured say of parameters and coefficients, in prior units."""
    chain = knowledge.chain
    samples = averaged(chain, measured)
    situation = Situation(chain, knowledge.x, measured)
    parts = [fitted_additions(knowledge.effects, situation), together(rivals, situation)]
    additions = joined(parts, len(measured)).over(samples.average)
    known, total = len(knowledge.root), len(chain) + len(additions)
    x = np.zeros(total)
    x[:known] = np.concatenate([knowledge.x, coefficient_values(knowledge.effects)])
    root = np.eye(total)
    root[:known, :known] = knowledge.root
    said = information(chain, samples, x, excess_variance=knowledge.excess_variance, additions=additions)
    in_units: Floats = root.T @ said @ root
    return in_units


def _order(rig: Rig, seconds: Floats, poses: Candidates, separate: Sequence[str]) -> Integers:
    """(n,) a short way through the poses, those under the same slow conditions together.

    To and fro where one of the effects to be told apart grows with the path of its joint.
    """
    names = slow(poses.conditions)
    levels = np.column_stack([np.zeros(len(poses)), *(poses.conditions[name] for name in names)])
    _, block = np.unique(levels, axis=0, return_inverse=True)
    parts = [np.flatnonzero(block == number) for number in range(block.max() + 1)]
    places = [effect.partition("@") for effect in separate]
    travelling = [rig.joint_names.index(where) for name, _, where in places if library()[name].goes_by_travel]
    if travelling:
        low, high = limits(rig)
        share = ((poses.readings - low) / (high - low))[:, travelling].sum(axis=1)
        return np.concatenate([own[_to_and_fro(share[own])] for own in parts])
    return np.concatenate([own[short_tour(seconds[np.ix_(own, own)])] for own in parts])


def _to_and_fro(values: Floats) -> Integers:
    """(n,) the lower and the upper half of some values in turn."""
    rising = np.argsort(values, kind="stable")
    order = np.empty(len(values), dtype=np.intp)
    order[0::2], order[1::2] = np.split(rising, [(len(values) + 1) // 2])
    return order


def _sides(knowledge: Knowledge, candidates: Candidates) -> set[str]:
    """The directions of approach that effects of the model ask for."""
    joints = knowledge.chain.rig.joint_names
    poses = candidates.select(np.arange(1)).under([f"{name}_dir" for name in joints])
    blank = knowledge.unknown_variance(poses.readings)[0]
    told = knowledge.unknown_variance(poses.readings, poses.conditions)[0]
    return {f"{name}_dir" for name, more, less in zip(joints, blank, told, strict=True) if more > less}
