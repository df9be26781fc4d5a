"""Order of the poses of a plan: an open travelling-salesman path, by nearest neighbour and 2-opt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.design.candidates import Candidates
from calibration.design.conditions import slow
from calibration.design.exchange import Integers
from calibration.design.visibility import limits
from calibration.effects.library import library
from calibration.observations import Floats
from calibration.rig.description import Rig

_ROUNDS = 20
_WORK = 500  # number of poses times number of starts
_LESS = 1e-9  # s; smaller gains are rounding errors


def travel_s(rig: Rig, readings: Floats) -> Floats:
    """(n, n) travel times between poses (n, joints), s; all joints move at once, each at its `max_rate`."""
    rate = np.array([joint.max_rate for joint in rig.joints])
    scaled = readings / rate
    seconds: Floats = np.abs(scaled[:, None, :] - scaled[None, :, :]).max(axis=2)
    return seconds


def length_s(seconds: Floats, order: Integers) -> float:
    """Sum the travel times (n, n) from pose to pose in an order, s."""
    return float(seconds[order[:-1], order[1:]].sum())


def ordered(rig: Rig, seconds: Floats, poses: Candidates, separate: Sequence[str]) -> Integers:
    """Order poses for a short path, keeping poses with the same slow conditions together.

    The path alternates between low and high values of a joint where an effect to distinguish grows with its travel.

    Args:
        rig: the rig description.
        seconds: (n, n) travel times between the poses, s.
        poses: the poses.
        separate: effects to distinguish, `family@where`.

    Returns:
        (n,) indices of the poses.
    """
    names = slow(poses.conditions)
    levels = np.column_stack([np.zeros(len(poses)), *(poses.conditions[name] for name in names)])
    _, block = np.unique(levels, axis=0, return_inverse=True)
    parts = [np.flatnonzero(block == number) for number in range(block.max() + 1)]
    places = [effect.partition("@") for effect in separate]
    travelling = [rig.joint_names.index(where) for name, _, where in places if library()[name].depends_on_travel]
    if travelling:
        low, high = limits(rig)
        share = ((poses.readings - low) / (high - low))[:, travelling].sum(axis=1)
        return np.concatenate([own[_alternating(share[own])] for own in parts])
    return np.concatenate([own[short_tour(seconds[np.ix_(own, own)])] for own in parts])


def _alternating(values: Floats) -> Integers:
    """(n,) indices that alternate between the lower and the upper half of some values."""
    rising = np.argsort(values, kind="stable")
    order = np.empty(len(values), dtype=np.intp)
    order[0::2], order[1::2] = np.split(rising, [(len(values) + 1) // 2])
    return order


def short_tour(seconds: Floats) -> Integers:
    """Find an order (n,) with a short path through (n, n) travel times; both ends are free."""
    n = len(seconds)
    starts = np.unique(np.linspace(0, n - 1, max(1, min(n, _WORK // n))).astype(int))
    tours = [_two_opt(seconds, _nearest_neighbour(seconds, int(start))) for start in starts]
    return min(tours, key=lambda order: length_s(seconds, order))


def _nearest_neighbour(seconds: Floats, start: int) -> Integers:
    left = np.ones(len(seconds), dtype=bool)
    order = [start]
    left[start] = False
    while left.any():
        order.append(int(np.argmin(np.where(left, seconds[order[-1]], np.inf))))
        left[order[-1]] = False
    return np.array(order, dtype=np.intp)


def _two_opt(seconds: Floats, order: Integers) -> Integers:
    """Reverse sections of the path while that shortens it; the path is open, so its two ends cost nothing."""
    n = len(order)
    if n < 2:
        return order
    first, last = np.triu_indices(n, 1)
    padded = np.zeros((n + 1, n + 1))  # index n: nowhere
    padded[:n, :n] = seconds
    for _ in range(_ROUNDS * n):
        before = np.concatenate([[n], order[:-1]])[first]
        after = np.concatenate([order[1:], [n]])[last]
        left, right = order[first], order[last]
        gain = padded[before, left] + padded[right, after] - padded[before, right] - padded[left, after]
        best = int(np.argmax(gain))
        if gain[best] <= _LESS:
            break
        order = order.copy()
        order[first[best] : last[best] + 1] = order[first[best] : last[best] + 1][::-1]
    return order
