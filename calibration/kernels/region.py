"""How far rows lie outside the region that a residual was trained on; one pass over them, compiled.

The tables that describe the region are (rows, columns) arrays, so that a call for one pose costs microseconds.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.kernels.jit import compiled, part
from calibration.observations import Floats

# Rows of the table of joints, deg or mm.
CENTRE, HALF, MARGIN, SCALE, TURN = range(5)
# Rows of the table of signals, in the signal's unit; LOSS is a share and GAPS 0 or 1.
LOW, HIGH, ROOM, USUAL, LOSS, GAPS = range(6)

FADE = 2.0  # margins beyond the margin until nothing is left


@part()
def _falling(excess: float) -> float:
    """From 1 at no excess to 0 at 1, smooth at both ends."""
    if excess <= 0.0:
        return 1.0
    if excess >= 1.0:
        return 0.0
    return 1.0 - excess * excess * (3.0 - 2.0 * excess)


@part()
def _short_way(change: float, turn: float) -> float:
    """A change of an angle without the whole turns in it; other values, whose turn is 0, as they are."""
    if turn > 0.0 and 2.0 * abs(change) > turn:
        return change - turn * math.floor(change / turn + 0.5)
    return change


@part()
def _joint_weight(joints: Floats, row: int, readings: Floats) -> float:
    """Weight by the ranges of the joints; readings beyond theirs are taken on the turn nearest its centre."""
    weight = 1.0
    for k in range(joints.shape[1]):
        away = readings[row, k] - joints[CENTRE, k]
        if abs(away) > joints[HALF, k]:
            near = _short_way(away, joints[TURN, k])
            if near != away:
                readings[row, k] = joints[CENTRE, k] + near
                away = near
        weight *= _falling((abs(away) - joints[HALF, k] - joints[MARGIN, k]) / (FADE * joints[MARGIN, k]))
    return weight


@part()
def _nearness(joints: Floats, poses: Floats, near: float, row: int, readings: Floats) -> float:
    """Weight by the distance to the nearest of the poses: 1 up to `near`, nothing from twice that on."""
    least = 4.0 * near * near
    for m in range(len(poses)):
        square = 0.0
        for k in range(joints.shape[1]):
            away = _short_way(readings[row, k] - poses[m, k], joints[TURN, k]) / joints[SCALE, k]
            square += away * away
            if square >= least:
                break
        if square < least:
            least = square
            if least <= near * near:
                return 1.0
    return _falling(math.sqrt(least) / near - 1.0)


@part()
def _signal_weight(table: Floats, row: int, signals: Floats) -> float:
    """Weight by the signals; what is missing or out of range is drawn to its usual value."""
    lost = 0.0
    for k in range(table.shape[1]):
        value, trust = signals[row, k], 0.0
        if math.isfinite(value):
            away = max(table[LOW, k] - value, value - table[HIGH, k])
            trust = _falling((away - table[ROOM, k]) / (FADE * table[ROOM, k]))
            if trust < 1.0:
                signals[row, k] = table[USUAL, k] + trust * (value - table[USUAL, k])
        elif table[GAPS, k] > 0.0:
            trust = 1.0
        else:
            signals[row, k] = table[USUAL, k]
        lost += (1.0 - trust) * table[LOSS, k]
    return max(0.0, 1.0 - lost)


@compiled
def settle(joints: Floats, poses: Floats, near: float, table: Floats, readings: Floats, signals: Floats) -> Floats:
    """How much a residual counts in each row; readings and signals are brought into its region in place.

    Args:
        joints: (5, j) table of the joints.
        poses: (m, j) representative readings, deg or mm.
        near: distance to the nearest of them, in ranges of the joints, from which on weights fall.
        table: (6, s) table of the signals.
        readings: (n, j or more) deg or mm in the first j columns.
        signals: (n, s).

    Returns:
        (n,) weights from 0 to 1.
    """
    weight = np.empty(len(readings))
    for row in range(len(readings)):
        weight[row] = _joint_weight(joints, row, readings)
        if weight[row] > 0.0:
            weight[row] *= _nearness(joints, poses, near, row, readings)
        weight[row] *= _signal_weight(table, row, signals)
    return weight
