"""Choosing rows of a linear model: greedy additions, then exchanges, under a criterion of the posterior covariance.

Every candidate is a block of r rows W of a whitened Jacobian in prior units, so that the information before is the
identity and a set has the covariance C = (I + sum W'W)^-1. Adding a block lowers it by C W' G^-1 W C with
G = I + W C W' (Sherman, Morrison and Woodbury), so no candidate needs an inverse of the whole. The exchange is
Fedorov's (1972), restricted to the candidates that gain most, as the KL-exchange of Atkinson, Donev and Tobias
(Optimum Experimental Designs, 2007, section 12.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibration.observations import Floats

Integers = NDArray[np.intp]

_AT_ONCE = 256  # candidates looked at anew in one go
_SHORTLIST = 400
_SWEEPS = 6
_WORTHWHILE = 1e-4
_TOGETHER = 1000  # candidates, so that the work arrays stay small


class Criterion(Protocol):
    """Criterion that a design maximises."""

    def value(self, information: Floats) -> float:
        """Value of an information (q, q), the prior's included; larger is better."""

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        """(m,) gains in `value` by each of m blocks (m, r, q)."""


class Determinant:
    """D-optimal: the volume of the confidence ellipsoid of all parameters, as -log det."""

    def value(self, information: Floats) -> float:
        return float(np.linalg.slogdet(information)[1])

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        grown = _grown(_times(blocks, _inverse(information)), blocks)
        diagonal = np.diagonal(np.linalg.cholesky(grown), axis1=1, axis2=2)
        return np.asarray(2.0 * np.log(diagonal).sum(axis=1), dtype=np.float64)


@dataclass(frozen=True)
class Accuracy:
    """V-optimal: mean variance of predictions over the work volume, as -log.

    Attributes:
        root: (q, k) with root @ root' the mean of J'J over the volume, in prior units.
    """

    root: Floats

    def value(self, information: Floats) -> float:
        return -float(np.log(np.sum((_inverse(information) @ self.root) * self.root)))

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        covariance = _inverse(information)
        total = float(np.sum((covariance @ self.root) * self.root))
        projected = _times(blocks, covariance)
        seen = _times(projected, self.root)
        grown = _grown(projected, blocks)
        taken = (np.linalg.inv(grown) * (seen @ seen.transpose(0, 2, 1))).sum(axis=(1, 2))
        return np.asarray(-np.log1p(-np.minimum(taken / total, 1.0 - 1e-12)), dtype=np.float64)


@dataclass(frozen=True)
class Hypothesis:
    """One of several models, as what is known already leaves it.

    Attributes:
        mean: (q,) of all parameters; zero for those that it has not.
        free: (f,) indices of those that it has, whose covariance is the inverse of their information.
    """

    mean: Floats
    free: Integers


@dataclass(frozen=True)
class Discrimination:
    """The log odds that a design is expected to bring for a true model over another, whichever two they are.

    They are the Kullback-Leibler divergence of what the one predicts from what the other predicts (Box and Hill,
    Technometrics 9, 1967),

        1/2 (E |d|^2 - tr(C A) + ln|before + A| / |before| - ln|before_i + A_i| / |before_i|)

    with d the parameters of the true model less those that the other fits in the end, C = (before + A)^-1 of the other,
    A what the design tells, and the index i for the true one: the other predicts something else, and it has freedom
    that it has no need of. The least of them counts, softly.

    Attributes:
        models: two or more.
        before: (q, q) information of the prior and of all that is known already.
        pairs: indices of a true model and of one that it is to be told from.
    """

    models: tuple[Hypothesis, ...]
    before: Floats
    pairs: tuple[tuple[int, int], ...]

    def value(self, information: Floats) -> float:
        return -float(logsumexp(-self.log_odds(information)))

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        own = [np.ascontiguousarray(blocks[:, :, model.free]) for model in self.models]
        covariance = [_inverse(_block(information, model.free)) for model in self.models]
        projected = [_times(*pair) for pair in zip(own, covariance, strict=True)]
        scatter = [_grown(*pair) for pair in zip(projected, own, strict=True)]
        freedom = [2.0 * np.log(np.diagonal(np.linalg.cholesky(g), axis1=1, axis2=2)).sum(axis=1) for g in scatter]
        known = {
            j: _times(projected[j], _block(self.before, self.models[j].free)) @ projected[j].transpose(0, 2, 1)
            for j in {j for _, j in self.pairs}
        }
        left = self._left(information)
        now = self._log_odds(information, left)
        grown = np.repeat(now[:, None], len(blocks), axis=1)
        for number, (i, j) in enumerate(self.pairs):
            moved = _times(blocks, left[number])
            squares = moved @ moved.transpose(0, 2, 1) - known[j]
            off = np.trace(np.linalg.solve(scatter[j], squares), axis1=1, axis2=2)
            grown[number] += 0.5 * (off + freedom[j] - freedom[i])
        values: Floats = logsumexp(-now) - logsumexp(-grown, axis=0)
        return values

    def log_odds(self, information: Floats) -> Floats:
        """(pairs,) expected log odds of the one, if it is true, over the other."""
        return self._log_odds(information, self._left(information))

    def _log_odds(self, information: Floats, left: Sequence[Floats]) -> Floats:
        added = information - self.before
        freedom = [
            float(np.linalg.slogdet(_block(information, m.free))[1] - np.linalg.slogdet(_block(self.before, m.free))[1])
            for m in self.models
        ]
        noise = [float((_inverse(_block(information, m.free)) * _block(added, m.free)).sum()) for m in self.models]
        found = np.zeros(len(self.pairs))
        for number, (i, j) in enumerate(self.pairs):
            off = float((self._differences[number] * (added @ left[number])).sum())
            found[number] = 0.5 * (off - noise[j] + freedom[j] - freedom[i])
        return found

    @cached_property
    def _differences(self) -> list[Floats]:
        """(q, 1 + f) of each pair, the true model's parameters less the other's: means, and what is unknown of them."""
        found = []
        for true, other in ((self.models[i], self.models[j]) for i, j in self.pairs):
            root = np.zeros((len(self.before), 1 + len(true.free)))
            root[:, 0] = true.mean - other.mean
            root[true.free, 1:] = np.linalg.cholesky(_inverse(_block(self.before, true.free)))
            found.append(root)
        return found

    def _left(self, information: Floats) -> list[Floats]:
        """(q, 1 + f) of each pair, the same once the other is fitted to what the design tells."""
        added, found = information - self.before, []
        for (_, j), difference in zip(self.pairs, self._differences, strict=True):
            free, left = self.models[j].free, difference.copy()
            left[free] -= np.linalg.solve(_block(information, free), added[free] @ difference)
            found.append(left)
        return found


def choose(blocks: Floats, count: int, criterion: Criterion, before: Floats | None = None) -> Integers:
    """Choose different blocks, greedily and then by exchanges.

    Gains are looked at anew only where an old one is still among the largest. For the determinant they never grow as
    the set does, so this finds exactly the best candidate each time (Minoux 1978).

    Args:
        blocks: (n, r, q) candidates.
        count: number to choose.
        criterion: value to maximise.
        before: (q, q) information of earlier measurements, W'W in prior units; nothing by default.

    Returns:
        (count,) indices in the order in which they were added or exchanged.
    """
    known = _known(blocks, before)
    chosen = _greedy(blocks, count, criterion, known)
    for _ in range(_SWEEPS):
        if not _sweep(blocks, chosen, criterion, known):
            break
    return np.array(chosen, dtype=np.intp)


def improve(blocks: Floats, near: Integers, criterion: Criterion, before: Floats | None = None) -> Integers:
    """Choose one block for each of several poses, the best of those near it while the others stay.

    Coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995), whole poses being the coordinates.

    Args:
        blocks: (n, r, q).
        near: (n,) number of the pose, from 0, that each is near; the first of each is the pose's own, and stays where
            no other is better.
        criterion: as for `choose`.
        before: as for `choose`.

    Returns:
        Indices, one for each pose.
    """
    chosen = np.unique(near, return_index=True)[1]
    information = information_of(blocks[chosen], before)
    for place, old in enumerate(chosen.tolist()):
        information -= blocks[old].T @ blocks[old]
        others = np.flatnonzero(near == place)
        gained = criterion.gain(information, blocks[others])
        if gained.max() > gained[0]:
            chosen[place] = others[int(np.argmax(gained))]
        information += blocks[chosen[place]].T @ blocks[chosen[place]]
    return chosen


def covariance_of(blocks: Floats) -> Floats:
    """(q, q) posterior covariance in prior units when all blocks (n, r, q) are measured."""
    return _inverse(information_of(blocks))


def information_of(blocks: Floats, before: Floats | None = None) -> Floats:
    """(q, q) the inverse of that covariance, `before` as for `choose`."""
    rows = blocks.reshape(-1, blocks.shape[2])
    information: Floats = _known(blocks, before) + rows.T @ rows
    return information


def _known(blocks: Floats, before: Floats | None) -> Floats:
    """(q, q) the prior's information, and that of what has been measured."""
    prior: Floats = np.eye(blocks.shape[2])
    return prior if before is None else prior + before


def _greedy(blocks: Floats, count: int, criterion: Criterion, known: Floats) -> list[int]:
    information = known.copy()
    chosen: list[int] = []
    bound = _gains(blocks, np.arange(len(blocks)), information, criterion)
    for _ in range(count):
        fresh = np.zeros(len(blocks), dtype=bool)
        while True:
            # The likeliest first; what has been looked at in this round is not looked at again.
            best = int(np.argmax(bound))
            if fresh[best]:
                break
            stale = np.flatnonzero(~fresh & np.isfinite(bound))
            if len(stale) > _AT_ONCE:
                stale = stale[np.argpartition(-bound[stale], _AT_ONCE)[:_AT_ONCE]]
            bound[stale] = _gains(blocks, stale, information, criterion)
            fresh[stale] = True
        chosen.append(best)
        bound[best] = -np.inf
        information += blocks[best].T @ blocks[best]
    return chosen


def _sweep(blocks: Floats, chosen: list[int], criterion: Criterion, known: Floats) -> bool:
    """Try to exchange every chosen block for a better one, in place; return True if that was worthwhile."""
    rows = blocks[chosen].reshape(-1, blocks.shape[2])
    information = known + rows.T @ rows
    before = criterion.value(information)
    gains = _gains(blocks, np.arange(len(blocks)), information, criterion)
    gains[chosen] = -np.inf
    shortlist = np.argsort(-gains, kind="stable")[: min(_SHORTLIST, len(blocks) - len(chosen))]
    for place, old in enumerate(chosen):
        without = information - blocks[old].T @ blocks[old]
        others = np.append(shortlist[~np.isin(shortlist, chosen)], old)
        gained = _gains(blocks, others, without, criterion)
        best = int(others[int(np.argmax(gained))])
        if best != old and gained.max() > gained[-1] + _WORTHWHILE:
            chosen[place] = best
            information = without + blocks[best].T @ blocks[best]
    return criterion.value(information) > before + _WORTHWHILE * len(chosen)


def _gains(blocks: Floats, which: Integers, information: Floats, criterion: Criterion) -> Floats:
    parts = [which[first : first + _TOGETHER] for first in range(0, len(which), _TOGETHER)]
    return np.concatenate([criterion.gain(information, blocks[part]) for part in parts])


def _times(blocks: Floats, matrix: Floats) -> Floats:
    """(m, r, k) blocks (m, r, q) times a matrix (q, k), in one product."""
    m, r, q = blocks.shape
    product: Floats = (blocks.reshape(-1, q) @ matrix).reshape(m, r, -1)
    return product


def _grown(projected: Floats, blocks: Floats) -> Floats:
    """(m, r, r) G = I + W C W' of W C and W, each (m, r, q)."""
    grown: Floats = np.eye(blocks.shape[1]) + projected @ blocks.transpose(0, 2, 1)
    return grown


def _inverse(information: Floats) -> Floats:
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)


def _block(matrix: Floats, which: Integers) -> Floats:
    """(f, f) of a matrix (q, q)."""
    block: Floats = matrix[np.ix_(which, which)]
    return block
