"""Trained trees compiled into loops: LightGBM's prediction in microseconds, without LightGBM.

A row's values are first turned into ranks, the number of a column's thresholds below each: a byte. What is missing gets
the rank that sends it where its nodes say, so that no node has to know. Many rows go through a tree in blocks: a row
starts with label 0, and node k gives those of its label whose rank exceeds its own the label k + 1. That compares
bytes, of which the machine takes 32 or 64 at a time; walking down from the root needs fewer comparisons, but each waits
for the one before it. Walking is faster for a few rows.
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
_FEW = 12  # fewer rows than this walk
_RANKS = 255  # thresholds of a column, so that ranks 0 .. 255 fit a byte; a feature with more has several columns
_ZERO = float(np.float32(1e-35))  # LightGBM's kZeroThreshold: up to it a value is zero
_ZERO_OR_NAN = 1  # of `Tree.missing`
_PLAIN: Sequence[Literal["C", "A", "W"]] = ("C", "A", "W")  # the kind of array that numba compiles for


@dataclass(frozen=True)
class Forest:
    """Sums of trees, one for each output.

    Attributes:
        source: (c, 4) of each column of ranks: its feature, what is missing (as `Tree.missing`), and where its
            thresholds begin and end.
        missing_rank: (c,) rank of what is missing.
        threshold: of all columns, in ascending order within each.
        column, rank: (m,) of each node: where it looks, and the highest rank that goes left.
        label: (m,) of the rows that the node divides.
        child: (2 m,) node to the left and to the right of each, counted in its tree; -1 - label for a leaf.
        tree: (t + 1, 3) of each tree: its output, first node, first leaf value; the last row closes the others.
        leaf_value: of all trees, by label.
        outputs: how many.
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
        """Compile trees: one sequence for each output, summed in its order, which is LightGBM's."""
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
        """Sums of the trees; one thread, the interpreter's lock is released.

        Args:
            table: (n, k) rows, NaN where not measured.
            columns: (f,) column of the table that each feature is.

        Returns:
            (n, outputs).
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
    # Whole numbers of the size of labels and columns are exact in float64.
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
    """Give the rows of one label that go right the label `moved`."""
    own = np.uint8(moved)
    for r in range(_ROWS):
        labels[r] = own if (ranks[r] > rank) & (labels[r] == label) else labels[r]


@part()
def _walk(ranks: Bytes, columns: Integers, rank: Bytes, child: Integers) -> int:
    """Label of the leaf where a single row ends."""
    node = np.uint64(0)  # unsigned: a negative index would be counted from the end, which takes time to find out
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
