"""Poses that determine a model best: drawn inside the joint limits, in view of the station, chosen by exchange.

A pose brings the fixes of all prisms in view. They share the errors of the joints' readings, so their covariance is
Sigma_station + J_q Sigma_q J_q' with the second part common to them; what is known beforehand are the build tolerances,
or a model's covariance. With such a prior a redundant parameter is no obstacle: no pose changes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibration.design.exchange import (
    Accuracy,
    Criterion,
    Determinant,
    Integers,
    Separation,
    choose,
    covariance_of,
)
from calibration.design.knowledge import Knowledge, directions, observations_at, root_of
from calibration.design.tour import length_s, short_tour, travel_s
from calibration.design.visibility import Bodies, Flags, Site, in_view, is_reachable, limits
from calibration.effects.base import Situation
from calibration.effects.fitted import Choice, joined
from calibration.effects.library import library
from calibration.errors import DataError, UnsafeError
from calibration.identification.additions import Additions
from calibration.identification.identifiability import observability_indices
from calibration.identification.refinement import prior_precision
from calibration.identification.samples import reading_variance, station_covariance
from calibration.kinematics import Linearisation
from calibration.observations import Floats

CANDIDATES = 10_000
_BATCHES = 10
_MARGIN = 0.01  # of a joint's range, kept from its limits
_SEEN = 0.1  # as in identifiability: the data alone determine a direction within ten prior sigmas
_SAME = 1e-3  # of the plausible size of an effect's largest curve; smaller ones no fix shows
_LINEARISED_AT_ONCE = 2000


@dataclass(frozen=True)
class Candidates:
    """Poses that the rig can take.

    Attributes:
        readings: (n, joints) deg or mm.
        direction: (n, joints) from which side each joint is to come, -1 or 1.
        seen: (n, prisms) prisms in view.
    """

    readings: Floats
    direction: Floats
    seen: Flags

    def __len__(self) -> int:
        return len(self.readings)

    def select(self, which: Integers) -> Candidates:
        """The given poses."""
        return Candidates(self.readings[which], self.direction[which], self.seen[which])


@dataclass(frozen=True)
class Plan:
    """Poses to measure, in the order of a short motion.

    Attributes:
        poses: what to drive to and what is in view there.
        approached: joints whose direction of approach matters.
        seconds_of_motion: from the first to the last, every joint at its full rate.
        parameters, determined: how many the set-up can show, and how many directions of them the poses alone determine.
        observability: `O1` .. `O5` of the poses alone.
        root: (p + k, p + k) covariance of parameters and coefficients after the poses = root @ root'.
        stands_out: `family@where` of the effects to be told apart -> by how many sigma one of plausible size stands
            out from all else, the other effect included, in these poses alone.
    """

    poses: Candidates
    approached: tuple[str, ...]
    seconds_of_motion: float
    parameters: int
    determined: int
    observability: dict[str, float]
    root: Floats
    stands_out: dict[str, float]


def draw(knowledge: Knowledge, at: Site, rng: np.random.Generator, count: int = CANDIDATES) -> Candidates:
    """Random poses that the rig can take and in which the station sees a prism.

    Half of them are drawn evenly between the joint limits, half lean to the limits (arcsine law), where errors show
    most.

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
        drawn = low + margin + (high - low - 2.0 * margin) * share
        bodies = Bodies.of(chain, knowledge.x, drawn)
        view = in_view(bodies, at)
        good = is_reachable(bodies, at) & view.any(axis=1)
        readings, seen = np.concatenate([readings, drawn[good]]), np.concatenate([seen, view[good]])
        if len(readings) >= count:
            break
    if len(readings) == 0:
        raise UnsafeError(
            f"of {_BATCHES * count} poses inside the joint limits of rig {chain.rig.name!r} none is reachable with a "
            f"prism in view of the station at {', '.join(f'{c:.0f}' for c in at.station_mm)} mm in the base frame; "
            f"check the station's place and the floor"
        )
    readings, seen = readings[:count], seen[:count]
    return Candidates(readings, rng.choice([-1.0, 1.0], readings.shape), seen)


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
    separate: tuple[str, str] | None = None,
) -> Plan:
    """Choose poses.

    Args:
        knowledge: of the rig.
        candidates: at least `count` of them.
        count: how many poses.
        volume: (v, joints) poses of the work volume: choose for the accuracy of predictions there (V-optimal) and not
            for the parameters (D-optimal).
        separate: two effects, each the `family@where` of one in the library: choose to tell them apart, as if neither
            had been found yet.

    Raises:
        DataError: fewer candidates than poses; an effect that no choice of poses shows.
    """
    if len(candidates) < count:
        raise DataError("poses", f"only {len(candidates)} reachable poses in view were found, {count} are asked for")
    rig = knowledge.chain.rig
    before = knowledge.without(separate or ())
    known = len(before.root)
    columns: Additions | None = None
    approached = _approached(knowledge, candidates)
    groups: list[Integers] = []
    with threadpool_limits(1, user_api="blas"):  # the blocks are small: threads would wait for each other
        if separate is not None:
            columns, needed, sizes = _columns(before, candidates, separate)
            approached |= needed
            ends = known + np.cumsum(sizes)
            groups = [np.arange(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        blocks = whitened(before, candidates, columns)
        criterion: Criterion = Determinant()
        if separate is not None:
            criterion = Separation(tuple(groups))
        elif volume is not None:
            criterion = Accuracy(volume_root(knowledge, volume))
        which = choose(blocks, count, criterion)
        seconds = travel_s(rig, candidates.readings[which])
        order = short_tour(seconds)
        poses = candidates.select(which[order])
        covariance = covariance_of(blocks[which])
        after = covariance_of(whitened(knowledge, poses))
        alone = _alone(knowledge, poses)
    seen = alone[alone > _SEEN]
    return Plan(
        poses,
        tuple(name for name in rig.joint_names if name in approached),
        length_s(seconds, order),
        knowledge.parameters,
        len(seen),
        observability_indices(seen, int(poses.seen.sum())),
        knowledge.root @ root_of(after),
        {
            name: math.sqrt(float(np.trace(np.linalg.inv(covariance[np.ix_(group, group)]))) - len(group))
            for name, group in zip(separate or (), groups, strict=True)
        },
    )


def whitened(knowledge: Knowledge, candidates: Candidates, columns: Additions | None = None) -> Floats:
    """(n, 3 prisms, p + k) Jacobian of each pose's fixes in their sigmas, the parameters in prior units.

    Rows of prisms out of view are zero. `columns` have the coefficients of further effects for the candidates' rows;
    they come last.
    """
    prisms, known = len(knowledge.chain.rig.prisms), len(knowledge.root)
    total = known + (0 if columns is None else len(columns))
    out = np.empty((len(candidates), 3 * prisms, total))
    for first in range(0, len(candidates), _LINEARISED_AT_ONCE):
        rows = slice(first, min(first + _LINEARISED_AT_ONCE, len(candidates)))
        n = rows.stop - rows.start
        lin, by_known = knowledge.linearise(candidates.readings[rows], candidates.direction[rows])
        unknown = knowledge.unknown_variance(candidates.readings[rows], candidates.direction[rows])
        covariance = _noise(knowledge, lin, unknown, n)
        hidden = np.repeat(~candidates.seen[rows], 3, axis=1)
        covariance[hidden[:, :, None] | hidden[:, None, :]] = 0.0
        covariance[hidden[:, :, None] & np.eye(3 * prisms, dtype=bool)] = 1.0
        jacobian = np.empty((n * prisms, 3, total))
        jacobian[:, :, :known] = by_known @ knowledge.root
        if columns is not None:
            shift = np.repeat(columns.column[rows] * columns.prior_sigma, prisms, axis=0)
            jacobian[:, :, known:] = replace(columns, column=shift).moved_mm(lin.joint_jacobian)
        stacked = jacobian.reshape(n, 3 * prisms, total)
        stacked[hidden] = 0.0
        out[rows] = np.linalg.solve(np.linalg.cholesky(covariance), stacked)
    return out


def volume_root(knowledge: Knowledge, volume: Floats) -> Floats:
    """(p + k, r) root of the mean of J'J over poses (v, joints) and all prisms, the parameters in prior units."""
    _, jacobian = knowledge.linearise(volume)
    rows = (jacobian @ knowledge.root).reshape(-1, len(knowledge.root)) / np.sqrt(len(jacobian))
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64).T


def _noise(knowledge: Knowledge, lin: Linearisation, unknown: Floats, n: int) -> Floats:
    """(n, 3 prisms, 3 prisms) covariance of the fixes of each standstill; the readings' errors are common to them.

    So is what is `unknown` of the joints' values, variances (n * prisms, joints).
    """
    rig = knowledge.chain.rig
    size = 3 * len(rig.prisms)
    common = (lin.joint_jacobian * np.sqrt(reading_variance(rig) + unknown)[:, None, :]).reshape(n, size, -1)
    covariance: Floats = common @ common.transpose(0, 2, 1)
    own = station_covariance(rig, lin.position_mm, np.full(lin.position_mm.shape, np.nan))
    own = (own + knowledge.excess_variance * np.eye(3)).reshape(n, -1, 3, 3)
    for prism in range(len(rig.prisms)):
        block = slice(3 * prism, 3 * prism + 3)
        covariance[:, block, block] += own[:, prism]
    return covariance


def _alone(knowledge: Knowledge, poses: Candidates) -> Floats:
    """Singular values of what the poses alone say, each parameter in units of its build tolerance."""
    sigma = np.diag(prior_precision(knowledge.chain, 1.0) ** -0.5)
    rows = whitened(replace(knowledge, root=sigma, effects=()), poses)
    return np.asarray(np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False), dtype=np.float64)


# -- effects ---------------------------------------------------------------------------------------------------------


def _approached(knowledge: Knowledge, candidates: Candidates) -> set[str]:
    """Joints at which the model has an effect that asks from which side they came."""
    poses = candidates.select(np.arange(1))
    blank = knowledge.unknown_variance(poses.readings)[0]
    told = knowledge.unknown_variance(poses.readings, poses.direction)[0]
    return {name for name, more, less in zip(knowledge.chain.rig.joint_names, blank, told, strict=True) if more > less}


def _columns(
    knowledge: Knowledge, candidates: Candidates, effects: tuple[str, str]
) -> tuple[Additions, set[str], tuple[int, ...]]:
    """Columns of both effects in all their variants, the joints whose approach matters, columns of each effect."""
    rig = knowledge.chain.rig
    parts: list[Additions] = []
    approached: set[str] = set()
    blank = Situation(knowledge.chain, knowledge.x, observations_at(rig, candidates.readings))
    sides = directions(rig, candidates.direction)
    told = replace(blank, observations=observations_at(rig, candidates.readings, sides))
    for effect in effects:
        name, _, where = effect.partition("@")
        family = library()[name]
        situation = blank
        if not family.known(blank, where).all():
            situation = told
            approached.add(where)
        if not family.known(situation, where).all():
            raise DataError(effect, f"needs {family.needs(where)}, which poses alone do not give")
        variants = family.variants(situation, where)
        if not variants:
            raise DataError(effect, f"does nothing at {where} of rig {rig.name!r} in any pose")
        choices = [Choice(name, where, settings).additions(situation) for settings in variants]
        parts.append(_independent(joined(choices, len(candidates))))
    together = joined(parts, len(candidates))
    return together, approached, (len(parts[0]), len(parts[1]))


def _independent(additions: Additions) -> Additions:
    """The same curves with the same prior, as few columns at one joint: variants of an effect repeat each other."""
    scaled = additions.column * additions.prior_sigma
    _, size, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=False)
    kept = size > _SAME * size[0]
    names = tuple(f"{additions.names[0].partition(':')[0]}:{i}" for i in range(int(kept.sum())))
    return Additions(names, additions.joint[: len(names)], scaled @ directions[kept].T, np.ones(len(names)))
