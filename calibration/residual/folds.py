"""Grouped folds: rows that know of each other are never on both sides of a split."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Observations, cell_mm

Integers = NDArray[np.intp]


def group_labels(observations: Observations) -> NDArray[np.str_]:
    """(n,) `Observations.groups`, with all fixes of one standstill in a single group.

    They share the random errors of the readings: a learner that sees one of them "predicts" the others. Among the
    groups of a standstill's fixes it is the one that fewest standstills have: the cell of a prism that stands still
    while the joints beyond it are swept would tie the whole sweep together.
    """
    labels = observations.groups()
    rows = np.flatnonzero(observations.pose != "")
    names = [part[rows] for part in (observations.session, observations.setup, observations.pose)]
    standstill = np.unique(np.column_stack(names), axis=0, return_inverse=True)[1].reshape(-1)
    known, group = np.unique(labels[rows], return_inverse=True)
    pairs = np.unique(np.column_stack([standstill, group]), axis=0)
    standstills_of = np.bincount(pairs[:, 1], minlength=len(known))
    rarest_first = pairs[np.lexsort((standstills_of[pairs[:, 1]], pairs[:, 0]))]
    rarest = rarest_first[np.unique(rarest_first[:, 0], return_index=True)[1], 1]
    out = labels.copy()
    out[rows] = known[rarest[standstill]]
    return out


def standstill_labels(observations: Observations) -> NDArray[np.str_]:
    """(n,) labels of fixes whose errors hang together: of one standstill, or while moving of one workspace cell.

    What a test over fixes may take for one draw, whatever the number of prisms at a standstill.
    """
    cells = np.char.add("cell ", observations.cells(cell_mm(observations.position_mm, observations.setup)))
    place = np.where(observations.pose != "", np.char.add("pose ", observations.pose), cells)
    within = np.char.add(np.char.add(observations.setup, "|"), np.char.add(observations.session, "|"))
    return np.char.add(within, place)


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
