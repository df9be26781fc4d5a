"""Reader for LightGBM's model text; LightGBM's own parser ends the process on a truncated or hostile text.

Only the output of `residual.trees.boosting` is read: regression trees with numerical splits and constant leaves.
Anything else is refused, so that no wrong prediction is made.
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
_MOST = 1e300  # greatest magnitude of a number
_DEFAULT_LEFT = 2  # bits of a decision type: 1 categorical, 2 missing values go left, 4 and 8 kind of missing values
_DECISIONS = frozenset({0, 2, 4, 6, 8, 10})
_HEADER = {"version": "v4", "num_class": "1", "num_tree_per_iteration": "1", "objective": "regression"}
_END = "end of trees"

N = TypeVar("N", int, float)


@dataclass(frozen=True)
class Tree:
    """One regression tree with k inner nodes, where parents come before their children.

    A row starts with label 0. At each node in turn, the rows that have the node's label and whose value goes right get
    the node's number plus one as their label. The final label of a row is its leaf.

    Attributes:
        feature: (k,) column that each node tests.
        threshold: (k,) values up to it go left; infinity separates missing values from all others.
        missing: (k,) values that count as missing: 0 none (NaN counts as zero), 1 zero and NaN, 2 NaN.
        missing_left: (k,) True where a missing value goes left.
        label: (k,) label of the rows that the node divides.
        child: (k, 2) left and right child; -1 - label for a leaf.
        gain: (k,) reduction of the squared error by each split.
        leaf_value: (k + 1,) values by label.
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
        text: result of LightGBM's `model_to_string`.
        features: number of columns in training.

    Raises:
        ValueError: the text is truncated, edited, for a different number of columns, or of an unsupported kind.
    """
    if len(text) > _TEXT_MAX:
        raise ValueError(f"the text of the trees is longer than {_TEXT_MAX} bytes")
    try:
        lines = text.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError("the text of the trees is not ASCII") from error
    if not lines or lines[0] != "tree":
        raise ValueError("the text does not start like a LightGBM model")
    try:
        end = lines.index(_END)
    except ValueError as error:
        raise ValueError(f"the text of the trees is truncated: {_END!r} is missing") from error
    starts = [number for number, line in enumerate(lines[:end]) if line.startswith("Tree=")]
    header = _settings(lines[1 : starts[0] if starts else end])
    for name, value in _HEADER.items():
        if header.get(name) != value:
            raise ValueError(f"the trees have {name} {header.get(name)!r:.60}; only {value!r} is supported")
    if "average_output" in lines[1:end]:
        raise ValueError("the trees are a random forest, which is not supported")
    if header.get("max_feature_idx") != str(features - 1):
        raise ValueError("the number of features of the trees differs from the list of names")
    if len(header.get("tree_sizes", "").split()) != len(starts):
        raise ValueError("the number of trees in the text differs from its list of sizes")
    blocks = [lines[first:last] for first, last in zip(starts, [*starts[1:], end], strict=True)]
    return tuple(_tree(number, block, features) for number, block in enumerate(blocks))


def _settings(lines: Sequence[str]) -> dict[str, str]:
    parts = (line.partition("=") for line in lines)
    return {name: value for name, equals, value in parts if equals}


def _tree(number: int, lines: Sequence[str], features: int) -> Tree:
    found = _settings(lines)
    try:
        if found["Tree"] != str(number):
            raise ValueError(f"its number is {found['Tree'][:20]!r}")
        leaves = int(found["num_leaves"])
        if not 1 <= leaves <= LEAVES_MAX:
            raise ValueError(f"it has {leaves} leaves; 1 .. {LEAVES_MAX} are supported")
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
        raise ValueError(f"there are {len(words)} values instead of {count}")
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
    """Number the nodes, parents before children, and the leaves by label; raise ValueError if they form no tree."""
    if not all(0 <= f < features for f in feature):
        raise ValueError("it splits on a column that does not exist")
    if not _DECISIONS.issuperset(decision):
        raise ValueError("it has an unsupported kind of split")
    count = len(feature)
    # In LightGBM a child of -1 - k is leaf k. Every leaf, and every node except the root, has one parent.
    if sorted(left + right) != [*range(-count - 1, 0), *range(1, count)] and count:
        raise ValueError("its nodes do not form a tree")
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
        raise ValueError("its nodes do not form a tree")
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
