"""Optimal design for a linear model: greedy additions, then exchanges, with a criterion of the posterior covariance.

Every candidate is a block of r rows W of a whitened Jacobian in prior units. The prior information is then the
identity, and a set has the covariance C = (I + sum W'W)^-1. Adding a block lowers C by C W' G^-1 W C with
G = I + W C W' (Sherman, Morrison and Woodbury), so no candidate needs the inverse of the full matrix. The exchange is
Fedorov's (1972), restricted to the candidates of largest gain, as in the KL-exchange of Atkinson, Donev and Tobias
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

_AT_ONCE = 256  # candidates whose gains are recomputed at once
_SHORTLIST = 400
_SWEEPS = 6
_WORTHWHILE = 1e-4
_TOGETHER = 1000  # candidates per batch, so that the work arrays stay small


class Criterion(Protocol):
    """Criterion that a design maximises."""

    def value(self, information: Floats) -> float:
        """Value of an information matrix (q, q) that includes the prior; larger is better."""

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        """(m,) increase of `value` by each of m blocks.

        Args:
            information: (q, q) information matrix without the blocks, including the prior.
            blocks: (m, r, q) blocks of r rows.
        """


class Determinant:
    """D-optimality: minus the log volume of the confidence ellipsoid, -log det of the covariance."""

    def value(self, information: Floats) -> float:
        return float(np.linalg.slogdet(information)[1])

    def gain(self, information: Floats, blocks: Floats) -> Floats:
        grown = _grown(_times(blocks, _inverse(information)), blocks)
        diagonal = np.diagonal(np.linalg.cholesky(grown), axis1=1, axis2=2)
        return np.asarray(2.0 * np.log(diagonal).sum(axis=1), dtype=np.float64)


@dataclass(frozen=True)
class Accuracy:
    """V-optimality: minus the log of the mean prediction variance over the work volume.

    Attributes:
        root: (q, k) root of the mean of J'J over the volume, root @ root', in prior units.
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
    """One of several models, given all knowledge before the design.

    Attributes:
        mean: (q,) mean of all parameters; zero for parameters that the model lacks.
        free: (f,) indices of the model's parameters. Their covariance is the inverse of their information.
    """

    mean: Floats
    free: Integers


@dataclass(frozen=True)
class Discrimination:
    """The log odds that a design is expected to bring for a true model against a false one, for any such pair.

    They are the Kullback-Leibler divergence between the predictions of the two models (Box and Hill, Technometrics 9,
    1967),

        1/2 (E |d|^2 - tr(C A) + ln|before + A| / |before| - ln|before_i + A_i| / |before_i|)

    where d is the true model's parameters minus those that the other model fits after the design,
    C = (before + A)^-1 of the other model, A the information of the design, and i denotes the true model. The first
    terms measure how much the predictions differ. The last two penalise free parameters that the other model does not
    need. The criterion is a soft minimum over the pairs.

    Attributes:
        models: two or more.
        before: (q, q) information of the prior and of all earlier measurements.
        pairs: pairs of indices: a true model, and a model to distinguish from it.
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
        """(pairs,) expected log odds of the true model against the other one."""
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
        """(q, 1 + f) for each pair: difference of the mean parameters, and the root of the true model's covariance."""
        found = []
        for true, other in ((self.models[i], self.models[j]) for i, j in self.pairs):
            root = np.zeros((len(self.before), 1 + len(true.free)))
            root[:, 0] = true.mean - other.mean
            root[true.free, 1:] = np.linalg.cholesky(_inverse(_block(self.before, true.free)))
            found.append(root)
        return found

    def _left(self, information: Floats) -> list[Floats]:
        """(q, 1 + f) for each pair: `_differences` after the other model is fitted to the design's measurements."""
        added, found = information - self.before, []
        for (_, j), difference in zip(self.pairs, self._differences, strict=True):
            free, left = self.models[j].free, difference.copy()
            left[free] -= np.linalg.solve(_block(information, free), added[free] @ difference)
            found.append(left)
        return found


def choose(blocks: Floats, count: int, criterion: Criterion, before: Floats | None = None) -> Integers:
    """Choose distinct blocks, greedily and then by exchanges.

    Gains are recomputed only where an old gain is still among the largest. For the determinant, gains never grow with
    the set, so this finds the exact best candidate in every step (Minoux 1978).

    Args:
        blocks: (n, r, q) candidates.
        count: number of blocks to choose.
        criterion: criterion to maximise.
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
    """Replace each of several poses by the best block near it, while the other poses are held fixed.

    Coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995) with whole poses as the coordinates.

    Args:
        blocks: (n, r, q) candidates.
        near: (n,) index of the pose that each block is near. The first block of each pose is the pose itself, and is
            kept where no other is better.
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
    """(q, q) posterior information in prior units, the inverse of `covariance_of`.

    Args:
        blocks: (n, r, q) measured blocks.
        before: as for `choose`.
    """
    rows = blocks.reshape(-1, blocks.shape[2])
    information: Floats = _known(blocks, before) + rows.T @ rows
    return information


def _known(blocks: Floats, before: Floats | None) -> Floats:
    """(q, q) information of the prior and of earlier measurements."""
    prior: Floats = np.eye(blocks.shape[2])
    return prior if before is None else prior + before


def _greedy(blocks: Floats, count: int, criterion: Criterion, known: Floats) -> list[int]:
    information = known.copy()
    chosen: list[int] = []
    bound = _gains(blocks, np.arange(len(blocks)), information, criterion)
    for _ in range(count):
        fresh = np.zeros(len(blocks), dtype=bool)
        while True:
            # Largest bound first. Gains that were recomputed in this round are up to date.
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
    """Exchange each chosen block for a better one where possible, in place; return True if the gain was worthwhile."""
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
    """(m, r, r) G = I + W C W' from W C and W, each (m, r, q)."""
    grown: Floats = np.eye(blocks.shape[1]) + projected @ blocks.transpose(0, 2, 1)
    return grown


def _inverse(information: Floats) -> Floats:
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)


def _block(matrix: Floats, which: Integers) -> Floats:
    """(f, f) submatrix of a matrix (q, q)."""
    block: Floats = matrix[np.ix_(which, which)]
    return block
