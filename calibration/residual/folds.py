"""Grouped folds: rows that know of each other are never on both sides of a split."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Observations

Integers = NDArray[np.intp]


def group_labels(observations: Observations) -> NDArray[np.str_]:
    """(n,) `Observations.groups`, with the fixes of one standstill in the group of its first.

    They share the random errors of the readings: a learner that sees one of them "predicts" the others.
    """
    labels = observations.groups().astype(object)
    first: dict[tuple[str, str, str], str] = {}
    for row, pose in enumerate(observations.pose.tolist()):
        if pose:
            key = (str(observations.session[row]), str(observations.setup[row]), pose)
            labels[row] = first.setdefault(key, labels[row])
    return labels.astype(np.str_)


def folds(groups: NDArray[np.str_], count: int, seed: int) -> Integers:
    """(n,) fold of every row: whole groups, dealt at random to the fold that has the fewest rows so far."""
    labels, index, size = np.unique(groups, return_inverse=True, return_counts=True)
    count = min(count, len(labels))
    fold = np.zeros(len(labels), dtype=np.intp)
    filled = np.zeros(count, dtype=np.intp)
    shuffled = np.random.default_rng(seed).permutation(len(labels))
    for group in shuffled[np.argsort(-size[shuffled], kind="stable")]:
        fold[group] = int(filled.argmin())
        filled[fold[group]] += size[group]
    return fold[index]
