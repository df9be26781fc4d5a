"""Trained trees compiled into loops: LightGBM's prediction in microseconds, without LightGBM.

A row's values are first converted to ranks: the number of thresholds of the column below the value, as a byte. A
missing value gets the rank that sends it in the direction for missing values, so that nodes need no special case. Many
rows pass through a tree in blocks: every row starts with label 0, and node k changes the label of rows with its label
and a rank above its own to k + 1. This compares bytes, of which the processor handles 32 or 64 at once. Walking down
from the root needs fewer comparisons, but each depends on the one before, so it is faster only for a few rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled, part
from calibration.observations import Floats
from calibration.residual.trees.tree_text import Tree

Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_ROWS = 256  # of a block
_FEW = 12  # with fewer rows, each walks down from the root
_RANKS = 255  # thresholds of a column, so that ranks 0 .. 255 fit a byte; a feature with more has several columns
_ZERO = float(np.float32(1e-35))  # LightGBM's kZeroThreshold: up to it a value is zero
_ZERO_OR_NAN = 1  # of `Tree.missing`
_PLAIN: Sequence[Literal["C", "A", "W"]] = ("C", "A", "W")  # requirements for arrays that are passed to numba


@dataclass(frozen=True)
class Forest:
    """Sums of trees, one for each output.

    Attributes:
        source: (c, 4) feature of each column of ranks, which values are missing (as `Tree.missing`), and first and end
            index of its thresholds.
        missing_rank: (c,) rank of missing values.
        threshold: thresholds of all columns, in ascending order within each.
        column, rank: (m,) column of each node, and the highest rank that goes left.
        label: (m,) label of the rows that each node divides.
        child: (2 m,) left and right child of each node, numbered within the tree; -1 - label for a leaf.
        tree: (t + 1, 3) output, first node and first leaf value of each tree; the last row is the end.
        leaf_value: leaf values of all trees, by label.
        outputs: number of outputs.
    """

    source: Integers
    missing_rank: Bytes
    threshold: Floats
    column: Integers
    rank: Bytes
    label: Bytes
    child: Integers
    tree: Integers
    leaf_value: Floats
    outputs: int

    @classmethod
    def build(cls, models: Sequence[Sequence[Tree]]) -> Forest:
        """Compile trees, one sequence for each output; they are summed in its order, which is LightGBM's."""
        trees = [tree for model in models for tree in model]
        kinds, kind_of_node = np.unique(
            np.column_stack([_joined(getattr(t, n) for t in trees) for n in ("feature", "missing", "missing_left")]),
            axis=0,
            return_inverse=True,
        )
        values = _joined(t.threshold for t in trees)
        column, rank = np.zeros(len(values), dtype=np.int64), np.zeros(len(values), dtype=np.uint8)
        source: list[tuple[int, int, int, int]] = []
        missing_rank: list[int] = []
        thresholds: list[Floats] = []
        end = 0
        for kind, (feature, missing, missing_left) in enumerate(kinds.astype(int).tolist()):
            nodes = kind_of_node == kind
            distinct, place = np.unique(values[nodes], return_inverse=True)
            column[nodes], rank[nodes] = len(source) + place // _RANKS, place % _RANKS
            for first in range(0, len(distinct), _RANKS):
                thresholds.append(distinct[first : first + _RANKS])
                begin, end = end, end + len(thresholds[-1])
                source.append((feature, missing, begin, end))
                missing_rank.append(0 if missing_left else end - begin)
        tree = np.zeros((len(trees) + 1, 3), dtype=np.int64)
        tree[:-1, 0] = np.repeat(np.arange(len(models)), [len(model) for model in models])
        tree[1:, 1] = np.cumsum([len(t.threshold) for t in trees])
        tree[1:, 2] = np.cumsum([len(t.leaf_value) for t in trees])
        return cls(
            source=np.array(source, dtype=np.int64).reshape(-1, 4),
            missing_rank=np.array(missing_rank, dtype=np.uint8),
            threshold=_joined(thresholds),
            column=column,
            rank=rank,
            label=_joined(t.label for t in trees).astype(np.uint8),
            child=_joined(t.child.reshape(-1) for t in trees).astype(np.int64),
            tree=tree,
            leaf_value=_joined(t.leaf_value for t in trees),
            outputs=len(models),
        )

    def predict(self, table: Floats, columns: Integers) -> Floats:
        """Return the sums of the trees; runs in one thread without the interpreter's lock.

        Args:
            table: (n, k) rows, NaN where not measured.
            columns: (f,) column of each feature in the table.

        Returns:
            (n, outputs) sums.
        """
        out = np.zeros((len(table), self.outputs))
        _predict(
            np.require(table, np.float64, _PLAIN),
            columns,
            self.source,
            self.missing_rank,
            self.threshold,
            self.column,
            self.rank,
            self.label,
            self.child,
            self.tree,
            self.leaf_value,
            out,
        )
        return out


def _joined(arrays: Iterable[NDArray[np.generic]]) -> Floats:
    # Integers as small as labels and columns are exact in float64.
    return np.concatenate([np.empty(0), *arrays]).astype(np.float64)


@part()
def _rank(
    table: Floats,
    first: int,
    count: int,
    feature: int,
    missing: int,
    missing_rank: int,
    threshold: Floats,
    ranks: Bytes,
) -> None:
    """Compute the ranks of one column for the rows of a block."""
    for r in range(count):
        value = table[first + r, feature]
        if abs(value) <= _ZERO or (np.isnan(value) and missing <= _ZERO_OR_NAN):
            value = 0.0
        if np.isnan(value) or (missing == _ZERO_OR_NAN and value == 0.0):
            ranks[r] = missing_rank
            continue
        below, size = 0, len(threshold)
        while size > 0:
            half = size >> 1
            is_above = threshold[below + half] < value
            below = below + half + 1 if is_above else below
            size = size - half - 1 if is_above else half
        ranks[r] = below


@part()
def _divide(ranks: Bytes, rank: int, label: int, moved: int, labels: Bytes) -> None:
    """Change the label of rows that have `label` and go right to `moved`."""
    own = np.uint8(moved)
    for r in range(_ROWS):
        labels[r] = own if (ranks[r] > rank) & (labels[r] == label) else labels[r]


@part()
def _walk(ranks: Bytes, columns: Integers, rank: Bytes, child: Integers) -> int:
    """Return the label of the leaf in which a single row ends."""
    node = np.uint64(0)  # unsigned, so that numba does not check for negative indices
    while True:
        goes_right = ranks[np.uint64(_ROWS * columns[node])] > rank[node]
        found = child[np.uint64(2 * node + goes_right)]
        if found < 0:
            return int(-1 - found)
        node = np.uint64(found)


@compiled
def _predict(
    table: Floats,
    columns: Integers,
    source: Integers,
    missing_rank: Bytes,
    threshold: Floats,
    column: Integers,
    rank: Bytes,
    label: Bytes,
    child: Integers,
    tree: Integers,
    leaf_value: Floats,
    out: Floats,
) -> None:
    ranks = np.zeros(_ROWS * len(source), dtype=np.uint8)
    labels = np.zeros(_ROWS, dtype=np.uint8)
    for first in range(0, len(table), _ROWS):
        count = min(_ROWS, len(table) - first)
        for c in range(len(source)):
            feature, of_column = columns[source[c, 0]], threshold[source[c, 2] : source[c, 3]]
            _rank(table, first, count, feature, source[c, 1], missing_rank[c], of_column, ranks[_ROWS * c :])
        for t in range(len(tree) - 1):
            output, begin, end, values = tree[t, 0], tree[t, 1], tree[t + 1, 1], leaf_value[tree[t, 2] :]
            for r in range(count):
                labels[r] = 0
            if count >= _FEW:
                for node in range(begin, end):
                    _divide(ranks[_ROWS * column[node] :], rank[node], label[node], node - begin + 1, labels)
            elif end > begin:
                for r in range(count):
                    labels[r] = _walk(ranks[r:], column[begin:], rank[begin:], child[2 * begin :])
            for r in range(count):
                out[first + r, output] += values[labels[r]]
