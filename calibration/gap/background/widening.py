"""Widening of a background: of all that pairs of joints may do to a machine, what the remaining errors ask for.

Errors of every joint by every pair of joints would be thousands of columns, and most of them are nothing. Each is held
against what a model leaves, as an addition to it at the scale that suits it best, and those that gain most are taken
one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from calibration.gap.background.blocks import Block
from calibration.gap.background.system import Model, System
from calibration.gap.projection import rows_of
from calibration.observations import Floats

PossibleBlocks = Callable[[], Iterator[Block]]

_SAMPLES = 700  # to choose by
_MOST = 8  # blocks at once
_LEAST_GAIN = 15.0  # log evidence
_SQUARED_SCALES = np.exp(np.linspace(-8.0, 6.0, 15))[:, None]


def further_blocks(system: System, model: Model, possible: PossibleBlocks) -> tuple[Block, ...]:
    """Return blocks that a model lacks and that what it leaves asks for, the one of the greatest gain first.

    Args:
        system: a linear model.
        model: with its effects and background.
        possible: yields the blocks to choose from; those that the system has are passed over.
    """
    found = _Additions(system, model, possible)
    chosen = [name for _ in range(_MOST) for name in found.take()]
    by_name = {block.name: block for block in possible() if block.name in chosen}
    return tuple(by_name[name] for name in chosen)


@dataclass
class _Addition:
    """Columns of a block in the whole, with their (k, k) and (k,) products beside the model."""

    columns: slice
    gram: Floats
    along: Floats

    def gain(self) -> tuple[float, float]:
        """Return the gain of log evidence at the best scale, and the square of that."""
        size, axes = np.linalg.eigh(self.gram)
        share = _SQUARED_SCALES * np.maximum(size, 0.0)
        squares = (axes.T @ self.along) ** 2 * _SQUARED_SCALES
        gains = 0.5 * (squares / (1.0 + share) - np.log1p(share)).sum(axis=1)
        best = int(np.argmax(gains))
        return float(gains[best]), float(_SQUARED_SCALES[best, 0])


class _Additions:
    """Blocks as additions to a model, by the products of their columns with everything in the model projected out."""

    def __init__(self, system: System, model: Model, possible: PossibleBlocks) -> None:
        projection, index = system.projection, model.scales.index
        rows = rows_of(_evenly(len(projection.target) // 3))
        here, noise = system.of_rows(rows).products, model.scales.noise
        sigma, in_model = model.scales.sigma, system.columns[np.ix_(rows, index)]
        matrix = here.gram[np.ix_(index, index)] * (sigma * sigma[:, None] / noise)
        matrix[np.diag_indices_from(matrix)] += 1.0
        factor = cholesky(matrix, lower=True)
        left = solve_triangular(factor, sigma * here.along[index] / noise, lower=True)
        self._parts: dict[str, _Addition] = {}
        columns, removed, count = list[Floats](), list[Floats](), 0
        for block in possible():
            if block.name in system.blocks:
                continue
            own = projection.whitened(projection.moved_mm(block.columns))[rows] * block.columns.prior_sigma
            own /= np.sqrt(noise)
            gone = solve_triangular(factor, sigma[:, None] * (in_model.T @ own) / np.sqrt(noise), lower=True)
            along = own.T @ projection.target[rows] / np.sqrt(noise) - gone.T @ left
            place = slice(count, count := count + own.shape[1])
            self._parts[block.name] = _Addition(place, own.T @ own - gone.T @ gone, along)
            columns.append(own)
            removed.append(gone)
        self._columns = np.hstack(columns) if columns else np.empty((len(rows), 0))
        self._removed = np.hstack([np.empty((len(index), 0)), *removed])
        self._taken = np.empty((0, count))

    def take(self) -> list[str]:
        """Return the name of the block that gains most, and project it out of all others; nothing where none gains."""
        gains = {name: part.gain() for name, part in self._parts.items()}
        name = max(gains, key=lambda n: gains[n][0], default="")
        if not name or gains[name][0] < _LEAST_GAIN:
            return []
        taken = self._parts.pop(name)
        own = taken.columns
        across = self._columns[:, own].T @ self._columns - self._removed[:, own].T @ self._removed
        across -= self._taken[:, own].T @ self._taken
        inner = across[:, own] + np.eye(across.shape[0]) / gains[name][1]
        factor = cholesky(inner, lower=True)
        gone = solve_triangular(factor, across, lower=True)
        left = solve_triangular(factor, taken.along, lower=True)
        self._taken = np.vstack([self._taken, gone])
        for part in self._parts.values():
            theirs = gone[:, part.columns]
            part.gram = part.gram - theirs.T @ theirs
            part.along = part.along - theirs.T @ left
        return [name]


def _evenly(count: int) -> np.ndarray:
    """Return the numbers of at most so many samples as are needed to choose by, evenly among all."""
    return np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).astype(np.intp))
