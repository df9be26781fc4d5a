"""Choosing rows of a linear model: greedy additions, then exchanges, under a criterion of the posterior covariance.

Every candidate is a block of r rows W of a whitened Jacobian in prior units, so that the covariance before is the
identity and a set has the covariance C = (I + sum W'W)^-1. Adding a block lowers it by C W' G^-1 W C with
G = I + W C W' (Sherman, Morrison and Woodbury), so no candidate needs an inverse of the whole. The exchange is
Fedorov's (1972), restricted to the candidates that gain most, as the KL-exchange of Atkinson, Donev and Tobias
(Optimum Experimental Designs, 2007, section 12.6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Integers = NDArray[np.intp]

_AT_ONCE = 256  # candidates looked at anew in one go
_SHORTLIST = 400
_SWEEPS = 6
_WORTHWHILE = 1e-4


class Criterion(Protocol):
    """What a design is chosen for."""

    def value(self, covariance: Floats) -> float:
        """How good a covariance (q, q) is; larger is better."""

    def gain(self, covariance: Floats, grown: Floats, projected: Floats) -> Floats:
        """(m,) how much `value` grows by each of m blocks W.

        Args:
            covariance: (q, q) C, before.
            grown: (m, r, r) G = I + W C W'.
            projected: (m, r, q) W C.
        """


class Determinant:
    """D-optimal: the volume of the confidence ellipsoid of all parameters, as -log det."""

    def value(self, covariance: Floats) -> float:
        return -float(np.linalg.slogdet(covariance)[1])

    def gain(self, covariance: Floats, grown: Floats, projected: Floats) -> Floats:
        del covariance, projected
        diagonal = np.diagonal(np.linalg.cholesky(grown), axis1=1, axis2=2)
        return np.asarray(2.0 * np.log(diagonal).sum(axis=1), dtype=np.float64)


@dataclass(frozen=True)
class Accuracy:
    """V-optimal: mean variance of predictions over the work volume, as -log.

    Attributes:
        root: (q, k) with root @ root' the mean of J'J over the volume, in prior units.
    """

    root: Floats

    def value(self, covariance: Floats) -> float:
        return -float(np.log(np.sum((covariance @ self.root) * self.root)))

    def gain(self, covariance: Floats, grown: Floats, projected: Floats) -> Floats:
        m, r, q = projected.shape
        total = float(np.sum((covariance @ self.root) * self.root))
        seen = (projected.reshape(-1, q) @ self.root).reshape(m, r, -1)
        taken = (np.linalg.inv(grown) * (seen @ seen.transpose(0, 2, 1))).sum(axis=(1, 2))
        return np.asarray(-np.log1p(-np.minimum(taken / total, 1.0 - 1e-12)), dtype=np.float64)


@dataclass(frozen=True)
class Separation:
    """D_s-optimal both ways: each group's determinant when all the rest, the other group too, is unknown.

    Attributes:
        groups: columns of each group.
    """

    groups: tuple[Integers, ...]

    def value(self, covariance: Floats) -> float:
        return -sum(float(np.linalg.slogdet(covariance[np.ix_(g, g)])[1]) for g in self.groups)

    def gain(self, covariance: Floats, grown: Floats, projected: Floats) -> Floats:
        gained = np.zeros(len(grown))
        for group in self.groups:
            part = projected[:, :, group]
            before = covariance[np.ix_(group, group)]
            after = before - part.transpose(0, 2, 1) @ np.linalg.solve(grown, part)
            gained += np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]
        return gained


def choose(blocks: Floats, count: int, criterion: Criterion, before: Floats | None = None) -> Integers:
    """Indices of `count` different blocks of (n, r, q), in the order in which they were added or exchanged.

    `before` (q, q) is the information of what has been measured already, W'W in prior units; nothing by default.

    Greedy: gains are looked at anew only where an old one is still among the largest. For the determinant they never
    grow as the set does, so this finds exactly the best candidate each time (Minoux 1978).
    """
    known = _known(blocks, before)
    chosen = _greedy(blocks, count, criterion, known)
    for _ in range(_SWEEPS):
        if not _sweep(blocks, chosen, criterion, known):
            break
    return np.array(chosen, dtype=np.intp)


def covariance_of(blocks: Floats, before: Floats | None = None) -> Floats:
    """(q, q) posterior covariance in prior units when all blocks (n, r, q) are measured, `before` as for `choose`."""
    rows = blocks.reshape(-1, blocks.shape[2])
    return _inverse(_known(blocks, before) + rows.T @ rows)


def _known(blocks: Floats, before: Floats | None) -> Floats:
    """(q, q) the prior's information, and that of what has been measured."""
    prior: Floats = np.eye(blocks.shape[2])
    return prior if before is None else prior + before


def _greedy(blocks: Floats, count: int, criterion: Criterion, known: Floats) -> list[int]:
    information = known.copy()
    chosen: list[int] = []
    bound = _gains(blocks, np.arange(len(blocks)), _inverse(information), criterion)
    for _ in range(count):
        covariance = _inverse(information)
        fresh = np.zeros(len(blocks), dtype=bool)
        while True:
            # The likeliest first; what has been looked at in this round is not looked at again.
            best = int(np.argmax(bound))
            if fresh[best]:
                break
            stale = np.flatnonzero(~fresh & np.isfinite(bound))
            if len(stale) > _AT_ONCE:
                stale = stale[np.argpartition(-bound[stale], _AT_ONCE)[:_AT_ONCE]]
            bound[stale] = _gains(blocks, stale, covariance, criterion)
            fresh[stale] = True
        chosen.append(best)
        bound[best] = -np.inf
        information += blocks[best].T @ blocks[best]
    return chosen


def _sweep(blocks: Floats, chosen: list[int], criterion: Criterion, known: Floats) -> bool:
    """Try to exchange every chosen block for a better one, in place; whether that was worthwhile."""
    q = blocks.shape[2]
    rows = blocks[chosen].reshape(-1, q)
    information = known + rows.T @ rows
    covariance = _inverse(information)
    before = criterion.value(covariance)
    gains = _gains(blocks, np.arange(len(blocks)), covariance, criterion)
    gains[chosen] = -np.inf
    shortlist = np.argsort(-gains, kind="stable")[: min(_SHORTLIST, len(blocks) - len(chosen))]
    for place, old in enumerate(chosen):
        without = information - blocks[old].T @ blocks[old]
        rivals = np.append(shortlist[~np.isin(shortlist, chosen)], old)
        gained = _gains(blocks, rivals, _inverse(without), criterion)
        best = int(rivals[int(np.argmax(gained))])
        if best != old and gained.max() > gained[-1] + _WORTHWHILE:
            chosen[place] = best
            information = without + blocks[best].T @ blocks[best]
    return criterion.value(_inverse(information)) > before + _WORTHWHILE * len(chosen)


def _gains(blocks: Floats, which: Integers, covariance: Floats, criterion: Criterion) -> Floats:
    gains = np.empty(len(which))
    for first in range(0, len(which), 1000):  # so that the work arrays stay small
        part = blocks[which[first : first + 1000]]
        m, r, q = part.shape
        projected: Floats = (part.reshape(-1, q) @ covariance).reshape(m, r, q)
        grown = np.eye(r) + projected @ part.transpose(0, 2, 1)
        gains[first : first + 1000] = criterion.gain(covariance, grown, projected)
    return gains


def _inverse(information: Floats) -> Floats:
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)
