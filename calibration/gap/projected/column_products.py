"""Products of the columns of effects in a projected space, each computed on first use.

An effect of a joint displaces the prism of a sample by the value of its column times the displacement per unit of the
joint's reading, which is the same for all effects of the joint. Of hundreds of splines of a curve, only four are
nonzero in a sample, and products use only these four values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from calibration.effects.columns import EffectColumns, joined
from calibration.gap.projected.projection import Projection
from calibration.gap.projected.rare_columns import RareColumns
from calibration.observations import Floats

_AT_ONCE = 64  # columns per batch
_KEPT = 20_000_000  # largest number of cached values; all of them would be gigabytes for thousands of fixes


class BlockProducts(Protocol):
    """Products of blocks of candidates' columns in a projected space."""

    def along(self, block: int) -> Floats:
        """Return (k,) the products of a block's columns with the target."""

    def product(self, a: int, b: int) -> Floats:
        """Return (k, l) the products of the columns of two blocks."""


@dataclass(frozen=True)
class _AtJoint:
    """Displacements of each of m samples per unit of a joint's reading.

    Attributes:
        whitened: (3 m, m) whitened displacements.
        transposed: (m, 3 m) the transposed matrix.
        removed: (m, q) components along the kinematics.
        along: (m,) products with the target.
    """

    whitened: csr_array
    transposed: csr_array
    removed: Floats
    along: Floats


class ProjectedProducts:
    """Products of columns with the kinematics of a projection projected out.

    Args:
        projection: the projected space.
        blocks: columns of the samples.
    """

    def __init__(self, projection: Projection, blocks: Sequence[EffectColumns]) -> None:
        self._projection, self._blocks = projection, blocks
        self._removed_target = projection.without_kinematics.removed(projection.target)
        self._rare = [block.sparse if isinstance(block, RareColumns) else None for block in blocks]
        self._at_joint: dict[int, _AtJoint] = {}
        self._between_joints: dict[tuple[int, int], csr_array] = {}
        self._kept = dict[int, Floats]()
        self._removed: dict[int, Floats] = {}
        self._along: dict[int, Floats] = {}
        self._gram: dict[tuple[int, int], Floats] = {}
        for number, own in enumerate(self._rare):
            if own is not None:
                at = self._at(number)
                self._removed[number] = (own.T @ at.removed).T
                self._along[number] = own.T @ at.along - self._removed[number].T @ self._removed_target
        for numbers in _batches(blocks, [n for n, own in enumerate(self._rare) if own is None]):
            self._add([*numbers])

    def along(self, block: int) -> Floats:
        """Return (k,) the products of a block's columns with the target."""
        return self._along[block]

    def product(self, a: int, b: int) -> Floats:
        """Return (k, l) the products of the columns of two blocks."""
        if (a, b) not in self._gram:
            product = self._whole_product(a, b) - self._removed[a].T @ self._removed[b]
            self._gram[a, b], self._gram[b, a] = product, product.T
        return self._gram[a, b]

    def _add(self, numbers: Sequence[int]) -> None:
        """Add blocks of dense columns, in a single pass over the rows."""
        projection = self._projection
        together = joined([self._blocks[number] for number in numbers], len(projection.samples))
        whitened = projection.whitened(projection.moved_mm(together))
        removed = projection.without_kinematics.removed(whitened)
        along = whitened.T @ projection.target - removed.T @ self._removed_target
        edges = np.cumsum([len(self._blocks[number]) for number in numbers])[:-1]
        each = (np.split(whitened, edges, axis=1), np.split(removed, edges, axis=1), np.split(along, edges))
        for number, rows, own, own_along in zip(numbers, *each, strict=True):
            self._gram[number, number] = rows.T @ rows - own.T @ own
            # Copy, as a view would keep the whole array in memory.
            self._removed[number], self._along[number] = own.copy(), own_along

    def _whole_product(self, a: int, b: int) -> Floats:
        """Return (k, l) the products of the whitened columns of two blocks, without projection."""
        rare_a, rare_b = self._rare[a], self._rare[b]
        if rare_a is None:
            return self._whitened(a).T @ self._whitened(b) if rare_b is None else self._whole_product(b, a).T
        if rare_b is None:
            return np.asarray(rare_a.T @ (self._at(a).transposed @ self._whitened(b)))
        # Convert explicitly, as SciPy would otherwise convert the larger matrix to the format of the transposed one.
        return np.asarray((rare_a.T.tocsr() @ (self._between(a, b) @ rare_b)).toarray())

    def _between(self, a: int, b: int) -> csr_array:
        """Return (m, m) the products of displacements per unit of reading at the joints of two blocks."""
        joints = int(self._blocks[a].joint[0]), int(self._blocks[b].joint[0])
        if joints not in self._between_joints:
            self._between_joints[joints] = self._at(a).transposed @ self._at(b).whitened
        return self._between_joints[joints]

    def _at(self, block: int) -> _AtJoint:
        """Return the displacements per unit of reading at the joint of a block with rare columns."""
        joint = int(self._blocks[block].joint[0])
        if joint not in self._at_joint:
            projection = self._projection
            whitened = projection.whitened_by_reading(joint)
            transposed = whitened.T.tocsr()
            with_kinematics = transposed @ projection.kinematics
            self._at_joint[joint] = _AtJoint(
                whitened,
                transposed,
                projection.without_kinematics.removed_by(with_kinematics.T).T,
                transposed @ projection.target,
            )
        return self._at_joint[joint]

    def _whitened(self, block: int) -> Floats:
        """Return (3 m, k) the whitened columns of a block."""
        if block not in self._kept:
            rows = self._projection.whitened(self._projection.moved_mm(self._blocks[block]))
            while self._kept and sum(kept.size for kept in self._kept.values()) + rows.size > _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[block] = rows
        return self._kept[block]


def _batches(blocks: Sequence[EffectColumns], numbers: Sequence[int]) -> Iterator[Sequence[int]]:
    """Yield numbers of blocks in batches of at most `_AT_ONCE` columns; wider blocks alone."""
    width = itertools.accumulate(len(blocks[number]) for number in numbers)
    batch = list[int]()
    first = 0
    for number, end in zip(numbers, width, strict=True):
        if batch and end - first > _AT_ONCE:
            yield batch
            batch, first = [], end - len(blocks[number])
        batch.append(number)
    if batch:
        yield batch
