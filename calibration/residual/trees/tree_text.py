"""LightGBM's model text, read without LightGBM: its own parser ends the process on a truncated or hostile one.

Only what `residual.trees.boosting` writes is read: regression trees with numerical splits and constant leaves.
Anything else is refused before a prediction could come out wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats

Integers = NDArray[np.int64]

LEAVES_MAX: Final = 256
_TEXT_MAX = 64 * 2**20
_MOST = 1e300  # size of a number
_DEFAULT_LEFT = 2  # bits of a decision type: 1 categorical, 2 missing values go left, 4 and 8 what is missing
_DECISIONS = frozenset({0, 2, 4, 6, 8, 10})
_HEADER = {"version": "v4", "num_class": "1", "num_tree_per_iteration": "1", "objective": "regression"}
_END = "end of trees"

N = TypeVar("N", int, float)


@dataclass(frozen=True)
class Tree:
    """One regression tree; a node is an inner one, parents come before their children.

    A row starts with label 0. At each node in turn, rows whose label is the node's and whose value goes right take the
    node's number plus one as their label; the label that they end with is their leaf.

    Attributes:
        feature: (k,) column that each node looks at.
        threshold: (k,) values up to it go left; infinity divides what is missing from all else.
        missing: (k,) values that count as missing: 0 nothing (NaN is taken for zero), 1 zero and NaN, 2 NaN.
        missing_left: (k,) True where a missing value goes left.
        label: (k,) of the rows that the node divides.
        child: (k, 2) node to the left and to the right; -1 - label for a leaf.
        gain: (k,) by how much each split lowered the squared error.
        leaf_value: (k + 1,) by label.
    """

    feature: Integers
    threshold: Floats
    missing: Integers
    missing_left: NDArray[np.bool_]
    label: Integers
    child: Integers
    gain: Floats
    leaf_value: Floats


def read_trees(text: bytes, features: int) -> tuple[Tree, ...]:
    """Read the trees of one model, in the order of their growth.

    Args:
        text: of LightGBM's `model_to_string`.
        features: number of columns it was trained on.

    Raises:
        ValueError: truncated, edited, trained on another number of columns, or of a kind that is not read.
    """
    if len(text) > _TEXT_MAX:
        raise ValueError(f"the text of the trees is longer than {_TEXT_MAX} bytes")
    try:
        lines = text.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError("the text of the trees is not ASCII") from error
    if not lines or lines[0] != "tree":
        raise ValueError("the text does not begin as LightGBM's does")
    try:
        end = lines.index(_END)
    except ValueError as error:
        raise ValueError(f"the text of the trees is truncated: {_END!r} is missing") from error
    starts = [number for number, line in enumerate(lines[:end]) if line.startswith("Tree=")]
    header = _settings(lines[1 : starts[0] if starts else end])
    for name, value in _HEADER.items():
        if header.get(name) != value:
            raise ValueError(f"the trees have {name} {header.get(name)!r:.60}, which is not read; only {value!r} is")
    if "average_output" in lines[1:end]:
        raise ValueError("the trees are a random forest, which is not read")
    if header.get("max_feature_idx") != str(features - 1):
        raise ValueError("the trees have another number of features than the list of names")
    if len(header.get("tree_sizes", "").split()) != len(starts):
        raise ValueError("the text of the trees lists another number of trees than it holds")
    blocks = [lines[first:last] for first, last in zip(starts, [*starts[1:], end], strict=True)]
    return tuple(_tree(number, block, features) for number, block in enumerate(blocks))


def _settings(lines: Sequence[str]) -> dict[str, str]:
    parts = (line.partition("=") for line in lines)
    return {name: value for name, equals, value in parts if equals}


def _tree(number: int, lines: Sequence[str], features: int) -> Tree:
    found = _settings(lines)
    try:
        if found["Tree"] != str(number):
            raise ValueError(f"it calls itself {found['Tree'][:20]!r}")
        leaves = int(found["num_leaves"])
        if not 1 <= leaves <= LEAVES_MAX:
            raise ValueError(f"it has {leaves} leaves; 1 .. {LEAVES_MAX} are read")
        if found["num_cat"] != "0" or found.get("is_linear", "0") != "0":
            raise ValueError("it has categorical splits or linear leaves")
        nodes = leaves - 1
        return _numbered(
            feature=_numbers(found["split_feature"], nodes, int),
            threshold=_numbers(found["threshold"], nodes, float, most=math.inf),
            decision=_numbers(found["decision_type"], nodes, int),
            left=_numbers(found["left_child"], nodes, int),
            right=_numbers(found["right_child"], nodes, int),
            gain=_numbers(found["split_gain"], nodes, float),
            leaf_value=_numbers(found["leaf_value"], leaves, float),
            features=features,
        )
    except KeyError as error:
        raise ValueError(f"tree {number} lacks {error.args[0]}") from error
    except ValueError as error:
        raise ValueError(f"tree {number} cannot be read: {error}") from error


def _numbers(text: str, count: int, kind: Callable[[str], N], most: float = _MOST) -> list[N]:
    words = text.split()
    if len(words) != count:
        raise ValueError(f"there are {len(words)} values where {count} are due")
    values = [kind(word) for word in words]
    if not all(-_MOST <= value <= most for value in values):  # False for NaN
        raise ValueError("a value is not finite")
    return values


def _numbered(
    feature: list[int],
    threshold: list[float],
    decision: list[int],
    left: list[int],
    right: list[int],
    gain: list[float],
    leaf_value: list[float],
    features: int,
) -> Tree:
    """Number the nodes, parents before children, and the leaves by label; ValueError where it is no tree."""
    if not all(0 <= f < features for f in feature):
        raise ValueError("it splits on a column that is not there")
    if not _DECISIONS.issuperset(decision):
        raise ValueError("it has a kind of split that is not read")
    count = len(feature)
    # A child of -1 - k is leaf k, as LightGBM has it; every leaf, and every node but the root, has one parent.
    if sorted(left + right) != [*range(-count - 1, 0), *range(1, count)] and count:
        raise ValueError("its nodes are no tree")
    order: list[int] = []
    labels: list[int] = []
    values = [math.nan] * (count + 1)
    children = [[0, 0] for _ in range(count)]
    waiting = [(0 if count else -1, 0, [0], 0)]
    while waiting:
        child, label, parent, side = waiting.pop()
        if child < 0:
            values[label] = leaf_value[-1 - child]
            parent[side] = -1 - label
            continue
        own = children[len(order)]
        parent[side] = len(order)
        order.append(child)
        labels.append(label)
        waiting += [(right[child], len(order), own, 1), (left[child], label, own, 0)]
    if len(order) != count:
        raise ValueError("its nodes are no tree")
    split = np.array(order, dtype=np.intp)
    types = np.array(decision, dtype=np.int64)[split]
    return Tree(
        feature=np.array(feature, dtype=np.int64)[split],
        threshold=np.array(threshold, dtype=np.float64)[split],
        missing=types >> 2,
        missing_left=(types & _DEFAULT_LEFT) > 0,
        label=np.array(labels, dtype=np.int64),
        child=np.array(children, dtype=np.int64).reshape(-1, 2),
        gain=np.array(gain, dtype=np.float64)[split],
        leaf_value=np.array(values),
    )
