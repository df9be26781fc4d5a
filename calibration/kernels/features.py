"""The columns that residual learners see, put together in one pass over the rows, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calibration.kernels.jit import compiled, part
from calibration.observations import Floats

RIGID = 6  # ways in which a base can be off


@part()
def _deflection(by_joint: Floats, loads: Floats, deg_per_nm: Floats) -> float:
    """What joints that give way do to one coordinate."""
    moved = 0.0
    for j in range(len(loads)):
        if math.isfinite(loads[j]):
            moved += by_joint[j] * (loads[j] * deg_per_nm[j])
    return moved


@part()
def _rigid(place: Floats, out: Floats) -> None:
    """Fill `out` (3, 6) with how shifts along the base frame's axes and turns about them move a place."""
    out[:] = 0.0
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        out[axis, axis] = 1.0
        out[one, 3 + axis], out[other, 3 + axis] = -place[other], place[one]


@compiled
def fill(
    readings: Floats,
    frames: Floats,
    place: Floats,
    by_joint: Floats,
    by_parameter: Floats,
    loads: Floats,
    deg_per_nm: Floats,
    measured: Floats,
    source: NDArray[np.intp],
    geometry: Floats,
    signals: Floats,
    parameters: Floats,
) -> None:
    """Fill `geometry`, `signals` and `parameters`, the Jacobian, of a `Features` of n rows.

    Args:
        readings: (n, joints) deg or mm.
        frames, place, by_joint, by_parameter: as a `Located` has them.
        loads: (n, joints) N m or N; NaN where not known, as if there were none.
        deg_per_nm: (joints,) by how much each joint gives way to its load.
        measured: (m, n) columns of the observations.
        source: (s,) where each signal is among measured columns, loads and the three coordinates of the deflection.
        others: to be filled.
    """
    joints, places, first = readings.shape[1], frames.shape[1] - 1, parameters.shape[2] - RIGID
    for n in range(len(readings)):
        geometry[n, :joints] = readings[n]
        for frame in range(places):
            geometry[n, joints + 3 * frame : joints + 3 * frame + 3] = frames[n, 1 + frame]
        geometry[n, joints + 3 * places :] = place[n]
        for k in range(len(source)):
            column = source[k]
            if column < len(measured):
                signals[n, k] = measured[column, n]
            elif column < len(measured) + joints:
                signals[n, k] = loads[n, column - len(measured)]
            else:
                signals[n, k] = _deflection(by_joint[n, column - len(measured) - joints], loads[n], deg_per_nm)
        parameters[n, :, :first] = by_parameter[n, :, :first]
        _rigid(place[n], parameters[n, :, first:])
