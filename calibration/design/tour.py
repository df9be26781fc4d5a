"""The order of poses that moves the machine least: an open travelling-salesman path, nearest neighbour and 2-opt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Floats
from calibration.rig import Rig

Integers = NDArray[np.intp]

_ROUNDS = 20
_WORK = 500  # poses times starts
_LESS = 1e-9  # s; less is rounding


def travel_s(rig: Rig, readings: Floats) -> Floats:
    """(n, n) seconds from pose to pose (n, joints): all joints move at once, each at its `max_rate`."""
    rate = np.array([joint.max_rate for joint in rig.joints])
    scaled = readings / rate
    seconds: Floats = np.abs(scaled[:, None, :] - scaled[None, :, :]).max(axis=2)
    return seconds


def length_s(seconds: Floats, order: Integers) -> float:
    """How long the way through (n, n) travel times takes in an order."""
    return float(seconds[order[:-1], order[1:]].sum())


def short_tour(seconds: Floats) -> Integers:
    """(n,) an order with a short way through (n, n) travel times; where it begins and ends is free."""
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
    """Turn parts of the way round while that shortens it; a step to or from nowhere takes no time."""
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
