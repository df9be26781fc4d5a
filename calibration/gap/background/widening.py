"""Widening of a background by blocks that the residuals require, such as errors by pairs of joints.

Errors of every joint as functions of every pair of joints would be thousands of columns, most of them zero. Each block
is evaluated against the residuals of a model, as an addition at its best scale, and the blocks of greatest gain are
added one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from calibration.effects.columns import joined
from calibration.gap.background.blocks import Block
from calibration.gap.background.evidence import posterior_factor
from calibration.gap.background.system import Model, System
from calibration.gap.projected.projection import rows_of
from calibration.observations import Floats

PossibleBlocks = Callable[[], Iterator[Block]]

_SAMPLES = 700  # samples used to choose blocks
_AT_ONCE = 500_000  # values of columns per batch
_COMPARED = 200  # number of blocks that are compared jointly, those of greatest individual gain
_MOST = 8  # largest number of blocks to return
_LEAST_GAIN = 15.0  # smallest gain of log evidence
_SQUARED_SCALES = np.exp(np.linspace(-8.0, 6.0, 15))[:, None]


def further_blocks(system: System, model: Model, possible: PossibleBlocks) -> tuple[Block, ...]:
    """Return blocks to add to a model because its residuals require them, greatest gain first.

    They are chosen from the `_COMPARED` blocks of greatest individual gain.

    Args:
        system: a linear model.
        model: the model with its effects and background.
        possible: function that yields the blocks to choose from; blocks of the system are skipped.
    """
    given = _InSomeRows(system, model)
    best: list[_Addition] = []
    for some in _batches(block for block in possible() if block.name not in system.blocks):
        best += given.additions(some)
        best = sorted(best, key=lambda own: -own.gain[0])[:_COMPARED]
    chosen = list(_chosen(best))
    by_name = {block.name: block for block in possible() if block.name in chosen} if chosen else {}
    return tuple(by_name[name] for name in chosen)


class _Addition:
    """A block as an addition to a model.

    Args:
        name: name of the block.
        own: (r, k) rows of the block's columns in prior sigmas, in units of the noise.
        removed: (q, k) components of the columns along the model. Products of columns minus products of these
            components are products of the columns with the model projected out.
        gram: (k, k) products of the columns with the model projected out.
        along: (k,) products of these with the residuals of the target.

    Attributes:
        gain: gain of log evidence at the best scale, and the square of that scale.
    """

    def __init__(self, name: str, own: Floats, removed: Floats, gram: Floats, along: Floats) -> None:
        self.name, self.own, self.removed, self.gram, self.along = name, own, removed, gram, along
        self.gain = _gain(gram, along)

    def given(self, taken: _Addition, factor: Floats, left: Floats) -> _Addition:
        """Return the same block given another block that is added to the model.

        Args:
            taken: the added block, with k columns.
            factor: (k, k) Cholesky factor of the posterior precision of its amplitudes.
            left: (k,) its products with the target, divided by that factor.
        """
        across = taken.own.T @ self.own - taken.removed.T @ self.removed
        gone = solve_triangular(factor, across, lower=True)
        removed = np.vstack([self.removed, gone])
        return _Addition(self.name, self.own, removed, self.gram - gone.T @ gone, self.along - gone.T @ left)


class _InSomeRows:
    """Products of further columns with a model projected out, in some of its rows."""

    def __init__(self, system: System, model: Model) -> None:
        self._projection, self._root = system.projection, np.sqrt(model.scales.noise)
        self._rows = rows_of(_evenly(len(self._projection.target) // 3))
        self._model = system.columns[np.ix_(self._rows, model.scales.index)] * model.scales.weight
        self._target = self._projection.target[self._rows] / self._root
        self._factor = posterior_factor(self._model.T @ self._model)
        self._left = solve_triangular(self._factor, self._model.T @ self._target, lower=True)

    def additions(self, blocks: Sequence[Block]) -> Iterator[_Addition]:
        """Yield blocks as additions to the model."""
        columns = joined([block.columns for block in blocks], blocks[0].columns.rows)
        moved_mm = self._projection.moved_mm(columns)
        every = self._projection.whitened(moved_mm)[self._rows] * (columns.prior_sigma / self._root)
        removed = solve_triangular(self._factor, self._model.T @ every, lower=True)
        along = every.T @ self._target - removed.T @ self._left
        first = 0
        for block in blocks:
            part = slice(first, first := first + len(block.columns))
            own, gone = every[:, part].copy(), removed[:, part].copy()
            yield _Addition(block.name, own, gone, own.T @ own - gone.T @ gone, along[part])


def _batches(blocks: Iterator[Block]) -> Iterator[list[Block]]:
    """Yield blocks in batches, displacements separate from joint errors, as both together would be mostly zeros."""
    for _, same in groupby(blocks, lambda block: block.columns.shift_mm is None):
        some, count = list[Block](), 0
        for block in same:
            some.append(block)
            count += block.columns.column.size
            if count >= _AT_ONCE:
                yield some
                some, count = [], 0
        if some:
            yield some


def _chosen(possible: list[_Addition]) -> Iterator[str]:
    """Yield the name of the block of greatest gain, then of the next given it, and so on while the gain suffices."""
    for _ in range(_MOST):
        taken = max(possible, key=lambda own: own.gain[0], default=None)
        if taken is None or taken.gain[0] < _LEAST_GAIN:
            return
        yield taken.name
        factor = cholesky(taken.gram + np.eye(len(taken.gram)) / taken.gain[1], lower=True)
        left = solve_triangular(factor, taken.along, lower=True)
        possible = [own.given(taken, factor, left) for own in possible if own is not taken]


def _gain(gram: Floats, along: Floats) -> tuple[float, float]:
    """Return the gain of log evidence by columns at their best scale, and the square of that scale.

    Args:
        gram: (k, k) products of the columns with the model projected out.
        along: (k,) products of these with the residuals of the target.
    """
    size, axes = np.linalg.eigh(gram)
    share = _SQUARED_SCALES * np.maximum(size, 0.0)
    squares = (axes.T @ along) ** 2 * _SQUARED_SCALES
    gains = 0.5 * (squares / (1.0 + share) - np.log1p(share)).sum(axis=1)
    best = int(np.argmax(gains))
    return float(gains[best]), float(_SQUARED_SCALES[best, 0])


def _evenly(count: int) -> np.ndarray:
    """Return the indices of at most `_SAMPLES` evenly spread samples."""
    return np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).astype(np.intp))
