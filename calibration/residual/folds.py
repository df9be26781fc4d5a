"""Grouped folds: rows with dependent errors are never on both sides of a split."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.groups import path_stretches, same_readings
from calibration.observations import Floats, Observations, cell_mm

Integers = NDArray[np.intp]


def group_labels(observations: Observations) -> NDArray[np.str_]:
    """Return (n,) group labels that reflect how the data were taken, with all fixes of a standstill in one group.

    Groups are sessions or set-ups if there are several, else stretches of the path that the poses follow, else cells of
    the workspace. Fixes of a standstill share the random errors of the readings, so a learner that has seen one of them
    "predicts" the others. If the fixes of a standstill are in several groups, all are put in the group with the fewest
    standstills: the cell of a prism that does not move while the joints beyond it are swept would otherwise join the
    whole sweep.
    """
    if len(observations) == 0:
        return np.zeros(0, dtype=np.str_)
    return _by_standstill(_as_taken(observations), observations)


def neighbour_labels(observations: Observations) -> NDArray[np.str_]:
    """Return (n,) labels of stretches or cells as in `group_labels`, but within each session and set-up.

    A fit that is tested on new poses leaves out these groups. It cannot leave out all fixes of a set-up, as it would
    then not know the base there.
    """
    if len(observations) == 0:
        return np.zeros(0, dtype=np.str_)
    track = np.char.add(_tracks(observations).astype(np.str_), "|")
    return _by_standstill(np.char.add(track, _places(observations)), observations)


def _by_standstill(labels: NDArray[np.str_], observations: Observations) -> NDArray[np.str_]:
    """Return (n,) labels with the same one for all fixes of a standstill: the one with the fewest standstills."""
    standstill = _standstills(observations)
    known, group = np.unique(labels, return_inverse=True)
    pairs = np.unique(np.column_stack([standstill, group]), axis=0)
    standstills_of = np.bincount(pairs[:, 1], minlength=len(known))
    rarest_first = pairs[np.lexsort((standstills_of[pairs[:, 1]], pairs[:, 0]))]
    rarest = rarest_first[np.unique(rarest_first[:, 0], return_index=True)[1], 1]
    return np.asarray(known[rarest[standstill]], dtype=np.str_)


def standstill_labels(observations: Observations) -> NDArray[np.str_]:
    """Return (n,) labels of fixes with dependent errors: of one standstill, or of one stretch or cell while moving.

    A statistical test over fixes counts each label as one independent draw, whatever the number of prisms.
    """
    place = np.where(observations.pose != "", np.char.add("pose ", observations.pose), _places(observations))
    within = np.char.add(np.char.add(observations.setup, "|"), np.char.add(observations.session, "|"))
    return np.char.add(within, place)


def _places(observations: Observations) -> NDArray[np.str_]:
    """Return (n,) stretches of a path, or cells of the workspace if there is no path."""
    stretch = _stretches(observations)
    if stretch is None:
        return np.char.add("cell ", observations.cells(cell_mm(observations.position_mm, observations.setup)))
    return np.char.add("stretch ", stretch.astype(np.str_))


def _as_taken(observations: Observations) -> NDArray[np.str_]:
    """Return (n,) sessions or set-ups if there are several, else stretches of a path, else cells of the workspace."""
    stretch = None
    if not any(len(np.unique(labels)) > 1 for labels in (observations.session, observations.setup)):
        stretch = _stretches(observations)
    return observations.groups() if stretch is None else np.char.add("stretch ", stretch.astype(np.str_))


def _stretches(observations: Observations) -> Integers | None:
    """Return (n,) `path_stretches` of rows in the order of time, or in the given order if any time is missing."""
    order = np.arange(len(observations))
    time_s = observations.extra.get("time_s")
    if time_s is not None and np.isfinite(time_s).all():
        order = np.argsort(time_s, kind="stable")
    found = path_stretches(_readings(observations)[order], _tracks(observations)[order])
    if found is None:
        return None
    out = np.empty_like(found)
    out[order] = found
    return out


def _standstills(observations: Observations) -> Integers:
    """Return (n,) numbers of standstills: fixes of one pose, or with the same readings if the pose has no name."""
    track, named = _tracks(observations), observations.pose != ""
    out = same_readings(_readings(observations), track)
    pose = np.unique(observations.pose, return_inverse=True)[1].reshape(-1)
    by_name = np.unique(np.column_stack([track, pose]), axis=0, return_inverse=True)[1].reshape(-1)
    either = np.where(named, len(out) + by_name, out)
    return np.asarray(np.unique(either, return_inverse=True)[1].reshape(-1), dtype=np.intp)


def _readings(observations: Observations) -> Floats:
    return np.column_stack(list(observations.joints.values()))


def _tracks(observations: Observations) -> Integers:
    """Return the (n,) number of each row's session and set-up."""
    labels = np.column_stack([observations.session, observations.setup])
    return np.asarray(np.unique(labels, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.intp)


def folds(groups: NDArray[np.str_], count: int, seed: int) -> Integers:
    """Return the (n,) fold of every row; groups are assigned whole, at random, to the fold with the fewest rows.

    Args:
        groups: (n,) label of each row's group.
        count: number of folds; fewer if there are fewer groups.
        seed: seed of the assignment.
    """
    labels, index, size = np.unique(groups, return_inverse=True, return_counts=True)
    count = min(count, len(labels))
    fold = np.zeros(len(labels), dtype=np.intp)
    filled = np.zeros(count, dtype=np.intp)
    shuffled = np.random.default_rng(seed).permutation(len(labels))
    for group in shuffled[np.argsort(-size[shuffled], kind="stable")]:
        fold[group] = int(filled.argmin())
        filled[fold[group]] += size[group]
    return fold[index]
