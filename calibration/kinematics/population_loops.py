"""Compiled loops over observations for every candidate of a population.

From a prism back to the base there is one loop, or half of one, for each driven rotation. The coordinates of a chunk
stay in the first-level cache. Sines and cosines of the readings are computed once for all candidates, and the angles of
a candidate are added by the angle addition formulas, once for all prisms of a pose.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain_reduction import BLOCK, Integers
from calibration.numerics.jit import compiled, part
from calibration.observations import Floats

Working = NDArray[np.floating[Any]]  # float64 or float32, the precision of the loops

CHUNK = 256  # poses that are processed at a time
TILE = 8  # candidates that process a chunk one after the other, so that its readings are fetched once for all
LANES = 16  # the number of poses in a chunk is a multiple of this, so that vector registers are full
ADD_ANGLE, PLACE, MOVE, FIRST_STEP, FIRST_TURN, MOVED_STEP, STEP, STEP_MOVE, TWO_STEPS, COMPARE = range(
    10
)  # codes of the steps of a chunk

# The functions below take whole arrays and start indices, as slices inside them are free.


@part()
def _add_angle(table: Working, begin: int, constant: Working, segment: int, n: int, turned: Working) -> None:
    """Fill `turned` with cosines and sines of the driven angles plus alpha."""
    driven, out = table[begin:], turned[2 * CHUNK * segment :]
    c0, s0 = constant[segment, 0], constant[segment, 1]
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        out[m] = c * c0 - s * s0
        out[CHUNK + m] = s * c0 + c * s0


@part()
def _place(constant: Working, end: int, n: int, work: Working) -> None:
    """Set the coordinates to the prism's own."""
    x, y, z = constant[end, 4], constant[end, 5], constant[end, 8]
    for m in range(n):
        work[m] = x
        work[CHUNK + m] = y
        work[2 * CHUNK + m] = z


@part()
def _move(length: Working, begin: int, slide: Working, number: int, n: int, work: Working) -> None:
    """Move the coordinates by a driven length."""
    driven = length[begin:]
    x, y, z = slide[number, 0], slide[number, 1], slide[number, 2]
    for m in range(n):
        work[m] += x * driven[m]
        work[CHUNK + m] += y * driven[m]
        work[2 * CHUNK + m] += z * driven[m]


@part()
def _first_step(table: Working, begin: int, constant: Working, segment: int, end: int, n: int, work: Working) -> None:
    """Take the first step, about the driven rotation nearest to a prism at a fixed position; reads no coordinates."""
    driven = table[begin:]
    x, y, z = constant[end, 4], constant[end, 5], constant[end, 8]
    cb, sb, a, b = constant[segment, 2], constant[segment, 3], constant[segment, 4], constant[segment, 5]
    y0, yc, ys = cb * b - sb * z, cb * y, cb * x
    z0, zc, zs = sb * b + cb * z, sb * y, sb * x
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        work[m] = a + c * x - s * y
        work[CHUNK + m] = y0 + c * yc + s * ys
        work[2 * CHUNK + m] = z0 + c * zc + s * zs


@part()
def _step(table: Working, begin: int, constant: Working, segment: int, n: int, work: Working) -> None:
    """Take the step p <- Rx(beta) (Rz(angle) p + (a, b, 0)) for all coordinates."""
    driven = table[begin:]
    cb, sb, a, b = constant[segment, 2], constant[segment, 3], constant[segment, 4], constant[segment, 5]
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        x, y, z = work[m], work[CHUNK + m], work[2 * CHUNK + m]
        x, y = a + c * x - s * y, b + s * x + c * y
        work[m] = x
        work[CHUNK + m] = cb * y - sb * z
        work[2 * CHUNK + m] = sb * y + cb * z


@part()
def _moved_step(
    table: Working,
    begin: int,
    constant: Working,
    segment: int,
    end: int,
    length: Working,
    moved: int,
    slide: Working,
    number: int,
    n: int,
    work: Working,
) -> None:
    """Take the first step for a prism that a driven length moves; reads no coordinates."""
    driven, out = table[begin:], length[moved:]
    px, py, pz = constant[end, 4], constant[end, 5], constant[end, 8]
    sx, sy, sz = slide[number, 0], slide[number, 1], slide[number, 2]
    cb, sb, a, b = constant[segment, 2], constant[segment, 3], constant[segment, 4], constant[segment, 5]
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        x, y, z = px + sx * out[m], py + sy * out[m], pz + sz * out[m]
        x, y = a + c * x - s * y, b + s * x + c * y
        work[m] = x
        work[CHUNK + m] = cb * y - sb * z
        work[2 * CHUNK + m] = sb * y + cb * z


@part()
def _step_move(
    turned: Working,
    begin: int,
    constant: Working,
    segment: int,
    length: Working,
    moved: int,
    slide: Working,
    number: int,
    n: int,
    work: Working,
) -> None:
    """Take a step, then move the coordinates by a driven length."""
    driven, out = turned[begin:], length[moved:]
    sx, sy, sz = slide[number, 0], slide[number, 1], slide[number, 2]
    cb, sb, a, b = constant[segment, 2], constant[segment, 3], constant[segment, 4], constant[segment, 5]
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        x, y, z = work[m], work[CHUNK + m], work[2 * CHUNK + m]
        x, y = a + c * x - s * y, b + s * x + c * y
        work[m] = x + sx * out[m]
        work[CHUNK + m] = cb * y - sb * z + sy * out[m]
        work[2 * CHUNK + m] = sb * y + cb * z + sz * out[m]


@part()
def _two_steps(
    turned: Working, begin: int, constant: Working, segment: int, other_begin: int, other: int, n: int, work: Working
) -> None:
    """Take two steps at once, with the coordinates kept in registers between them."""
    driven, other_driven = turned[begin:], turned[other_begin:]
    cb, sb, a, b = constant[segment, 2], constant[segment, 3], constant[segment, 4], constant[segment, 5]
    cb2, sb2, a2, b2 = constant[other, 2], constant[other, 3], constant[other, 4], constant[other, 5]
    for m in range(n):
        c, s = driven[m], driven[CHUNK + m]
        x, y, z = work[m], work[CHUNK + m], work[2 * CHUNK + m]
        x, y = a + c * x - s * y, b + s * x + c * y
        y, z = cb * y - sb * z, sb * y + cb * z
        c, s = other_driven[m], other_driven[CHUNK + m]
        x, y = a2 + c * x - s * y, b2 + s * x + c * y
        work[m] = x
        work[CHUNK + m] = cb2 * y - sb2 * z
        work[2 * CHUNK + m] = sb2 * y + cb2 * z


@part()
def _squares(target: Working, begin: int, ca: Any, sa: Any, n: int, work: Working) -> Any:
    """Return the sum of weighted squared distances of the coordinates, turned about z, from their targets."""
    own = target[begin:]
    total = work.dtype.type(0.0)
    for m in range(n):
        x, y = work[m], work[CHUNK + m]
        ex = ca * x - sa * y - own[m]
        ey = sa * x + ca * y - own[CHUNK + m]
        ez = work[2 * CHUNK + m] - own[2 * CHUNK + m]
        total += own[3 * CHUNK + m] * (ex * ex + ey * ey + ez * ez)
    return total


@part()
def _robust_squares(target: Working, begin: int, ca: Any, sa: Any, n: int, work: Working, inverse_scale: Any) -> Any:
    """Return the same sum with u / (1 + u * inverse_scale) of each weighted square u."""
    own = target[begin:]
    one = work.dtype.type(1.0)
    total = work.dtype.type(0.0)
    for m in range(n):
        x, y = work[m], work[CHUNK + m]
        ex = ca * x - sa * y - own[m]
        ey = sa * x + ca * y - own[CHUNK + m]
        ez = work[2 * CHUNK + m] - own[2 * CHUNK + m]
        square = own[3 * CHUNK + m] * (ex * ex + ey * ey + ez * ez)
        total += square / (one + square * inverse_scale)
    return total


@part()
def _errors(target: Working, begin: int, ca: Any, sa: Any, n: int, work: Working, error: Working) -> None:
    """Fill `error` with the errors of the coordinates turned about z, in the layout of the targets."""
    own, out = target[begin:], error[begin:]
    for m in range(n):
        x, y = work[m], work[CHUNK + m]
        out[m] = ca * x - sa * y - own[m]
        out[CHUNK + m] = sa * x + ca * y - own[CHUNK + m]
        out[2 * CHUNK + m] = work[2 * CHUNK + m] - own[2 * CHUNK + m]


@part()
def _pair_squares(error: Working, pair: Integers, weight: Floats, inverse_scale: float) -> float:
    """Return the sum of robust weighted squared differences between the errors at indices `pair` (k, 2)."""
    total = 0.0
    for k in range(len(pair)):
        square = 0.0
        for axis in range(3):
            difference = error[pair[k, 0] + axis * CHUNK] - error[pair[k, 1] + axis * CHUNK]
            square += difference * difference
        square *= weight[k]
        total += square / (1.0 + square * inverse_scale)
    return total


@part()
def _of_candidate(constants: Floats, slides: Floats, candidate: int, constant: Working, slide: Working) -> None:
    """Copy a candidate's constants and slides, in the precision of the loops."""
    block, j = candidate // BLOCK, candidate % BLOCK
    for k in range(len(constant)):
        for i in range(9):
            constant[k, i] = constants[block, k, i, j]
    for k in range(len(slide)):
        for i in range(3):
            slide[k, i] = slides[block, k, i, j]


@compiled
def fitness(  # noqa: PLR0912, PLR0915 - a function call for each choice of a loop would double the time
    constants: Floats,
    slides: Floats,
    todo: Integers,
    chunk: Integers,
    table: Working,
    length: Working,
    target: Working,
    turns: int,
    lengths: int,
    pair: Integers,
    pair_weight: Floats,
    inverse_scale: float,
    out: Floats,
) -> None:
    """Fill `out` with the fitness of candidates.

    Args:
        constants: constants of blocks of candidates, from `chain_reduction.reduce_chain`.
        slides: slides of blocks of candidates, from the same.
        todo: as `layout.Layout`.
        chunk: as `layout.Layout`.
        table: as `layout.Layout`; its type, which `length` and `target` share, determines the precision.
        length: as `layout.Layout`.
        target: as `layout.Layout`.
        turns: number of driven angles.
        lengths: number of driven lengths.
        pair: (k, 2) indices of pairs of observations in `target`.
        pair_weight: (k,) weight of each squared difference of two errors.
        inverse_scale: 1 / c^2 of the robust function, 0 for plain squares.
        out: (candidates,) result.
    """
    segments, slide_count = constants.shape[1], slides.shape[1]
    tile_constant = np.empty((TILE, segments, 9), table.dtype)
    tile_slide = np.empty((TILE, slide_count, 3), table.dtype)
    turned = np.empty(segments * 2 * CHUNK, table.dtype)
    work = np.empty(3 * CHUNK, table.dtype)
    tile_error = np.empty((TILE, len(target) if len(pair) > 0 else 0), table.dtype)
    scale = table.dtype.type(inverse_scale)
    one, zero = table.dtype.type(1.0), table.dtype.type(0.0)
    for start in range(0, len(out), TILE):
        tile = min(TILE, len(out) - start)
        for t in range(tile):
            out[start + t] = 0.0
            _of_candidate(constants, slides, start + t, tile_constant[t], tile_slide[t])
        for visit in range(len(chunk) * tile):
            number, t = visit // tile, visit % tile
            constant, slide, error = tile_constant[t], tile_slide[t], tile_error[t]
            total = 0.0
            n = chunk[number, 2]
            slot = chunk[number, 3] * 4 * CHUNK
            own_table, own_length = number * turns * 2 * CHUNK, number * lengths * CHUNK
            for entry in range(chunk[number, 0], chunk[number, 1]):
                what, segment, row = todo[entry, 0], todo[entry, 1], todo[entry, 2]
                begin = 2 * CHUNK * row
                if what == TWO_STEPS:
                    other_begin = 2 * CHUNK * todo[entry, 4]
                    _two_steps(turned, begin, constant, segment, other_begin, todo[entry, 3], n, work)
                elif what == STEP:
                    _step(turned, begin, constant, segment, n, work)
                elif what == ADD_ANGLE:
                    _add_angle(table, own_table + begin, constant, segment, n, turned)
                elif what == FIRST_STEP:
                    _first_step(table, own_table + begin, constant, segment, todo[entry, 3], n, work)
                elif what == STEP_MOVE:
                    moved = own_length + CHUNK * todo[entry, 4]
                    _step_move(turned, begin, constant, segment, length, moved, slide, todo[entry, 3], n, work)
                elif what == MOVED_STEP:
                    moved, at, end = own_length + CHUNK * todo[entry, 4], own_table + begin, todo[entry, 5]
                    _moved_step(table, at, constant, segment, end, length, moved, slide, todo[entry, 3], n, work)
                elif what == FIRST_TURN:
                    _step(table, own_table + begin, constant, segment, n, work)
                elif what == PLACE:
                    _place(constant, segment, n, work)
                elif what == MOVE:
                    _move(length, own_length + CHUNK * row, slide, segment, n, work)
                if what != COMPARE:
                    continue
                ca, sa = one, zero
                if segment >= 0:
                    ca, sa = constant[segment, 0], constant[segment, 1]
                if inverse_scale == 0.0:
                    total += _squares(target, slot, ca, sa, n, work)
                else:
                    total += _robust_squares(target, slot, ca, sa, n, work, scale)
                if len(pair) > 0:
                    _errors(target, slot, ca, sa, n, work, error)
                slot += 4 * CHUNK
            out[start + t] += total
        if len(pair) > 0:
            for t in range(tile):
                out[start + t] += _pair_squares(tile_error[t], pair, pair_weight, inverse_scale)
