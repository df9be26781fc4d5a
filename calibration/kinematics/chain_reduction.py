"""Reduction of a chain, for each candidate of a population, to one step for each driven rotation.

Between two driven rotations, which always turn about z, a chain is one rigid transform that depends only on the
candidate. Every rigid transform is Rz(alpha) Rx(beta) Trans(a, b, d) Rz(gamma). Its parts about or along z commute with
the adjacent driven rotations: alpha is added to the rotation before it, gamma to the one after it, and d is moved on
towards the prism. So a candidate needs one step for each driven rotation, p <- Rx(beta) (Rz(angle) p + (a, b, 0)), with
eight multiply-adds for each observation. Many candidates are reduced at a time, in float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled, part
from calibration.observations import Floats

Integers = NDArray[np.intp]

BLOCK = 64  # candidates that are reduced together
ROTATE, SHIFT, FIXED, SLIDE = 0, 1, 2, 3  # codes of instructions that change a segment's frame

# Cody and Waite's pi/2 in three parts, and the polynomials of fdlibm's __kernel_sin and __kernel_cos.
_ROUND = 1.5 * 2.0**52
_PIO2_1, _PIO2_2, _PIO2_3 = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


class SegmentTree(NamedTuple):
    """The constant parts of a chain, with which candidates are reduced.

    A *segment* is the run of constant transforms before a driven rotation (a joint segment) or before a prism (an end
    segment). A *slide* is a driven length inside a segment.

    Attributes:
        angle, angle_parameter: (angles) constant and searched parameter of each distinct angle.
        shift, shift_parameter: (shifts) constant and searched parameter of each distinct length.
        fixed: (f, 3, 4) rigid transforms without searched parameters.
        instruction: (i, 3) code, axis, and the index of the angle, length, rigid transform or slide.
        segment: (s, 4) number of instructions, segment before it (-1 for none), 1 for an end segment, first slide;
            parents come before their children.
    """

    angle: Floats
    angle_parameter: Integers
    shift: Floats
    shift_parameter: Integers
    fixed: Floats
    instruction: Integers
    segment: Integers


@part("contract")  # its accuracy depends on the order of its operations
def _cosines_sines(angle: Floats, cosine: Floats, sine: Floats) -> None:
    """Fill cosines and sines of `BLOCK` angles, accurate to the last bit or two; NaN beyond 1e9 rad."""
    for j in range(BLOCK):
        quarter = (angle[j] * (2.0 / math.pi) + _ROUND) - _ROUND
        quarter = quarter if abs(quarter) < 1e9 else math.nan
        r = ((angle[j] - quarter * _PIO2_1) - quarter * _PIO2_2) - quarter * _PIO2_3
        z = r * r
        s = r + r * z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * _S6)))))
        c = 1.0 - (0.5 * z - z * z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6))))))
        # An odd quadrant exchanges the two; the second half of the circle changes the sign of both.
        half = ((quarter * 0.5 - 0.25) + _ROUND) - _ROUND
        whole = ((half * 0.5 - 0.25) + _ROUND) - _ROUND
        odd = quarter - 2.0 * half
        sign = 1.0 - 2.0 * (half - 2.0 * whole)
        cosine[j] = sign * ((1.0 - odd) * c - odd * s)
        sine[j] = sign * ((1.0 - odd) * s + odd * c)


@part()
def _rotate(state: Floats, axis: int, cosine: Floats, sine: Floats) -> None:
    """Turn the frames about their own coordinate axis."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    for i in range(3):
        first, second = state[3 * i + u], state[3 * i + v]
        for j in range(BLOCK):
            old = first[j]
            first[j] = cosine[j] * old + sine[j] * second[j]
            second[j] = cosine[j] * second[j] - sine[j] * old


@part()
def _transform(state: Floats, fixed: Floats) -> None:
    """Append one rigid transform (3, 4) to all frames."""
    for i in range(3):
        x, y, z, t = state[3 * i], state[3 * i + 1], state[3 * i + 2], state[9 + i]
        for j in range(BLOCK):
            a, b, c = x[j], y[j], z[j]
            x[j] = a * fixed[0, 0] + b * fixed[1, 0] + c * fixed[2, 0]
            y[j] = a * fixed[0, 1] + b * fixed[1, 1] + c * fixed[2, 1]
            z[j] = a * fixed[0, 2] + b * fixed[1, 2] + c * fixed[2, 2]
            t[j] += a * fixed[0, 3] + b * fixed[1, 3] + c * fixed[2, 3]


@part()
def _shift(state: Floats, axis: int, size: Floats) -> None:
    """Move the frames along their own coordinate axis."""
    for i in range(3):
        along, moved = state[3 * i + axis], state[9 + i]
        for j in range(BLOCK):
            moved[j] += along[j] * size[j]


@part()
def _begin(state: Floats, constants: Floats, parent: int, is_end: bool) -> None:
    """Set the frames at the start of a segment: shifted by d of its parent, and turned by gamma for an end segment."""
    cg, sg, d = constants[parent, 6], constants[parent, 7], constants[parent, 8]
    for i in range(12):
        row = state[i]
        for j in range(BLOCK):
            row[j] = 1.0 if i in (0, 4, 8) else 0.0
    for j in range(BLOCK):
        state[11, j] = d[j]
        state[12, j] = cg[j]
        state[13, j] = sg[j]
    if is_end:
        _rotate(state, 2, cg, sg)


@part()
def _decompose(cell: Floats) -> None:
    """Split the frames into Rz(alpha) Rx(beta) Trans(a, b, d) Rz(gamma), and add the parent's gamma to alpha.

    `cell` is the state as one row, so that the compiler knows that nothing overlaps: the frames' twelve rows, cosine
    and sine of the parent's gamma, then the nine results, and cosine and sine of alpha without the parent's gamma.
    """
    B = BLOCK
    for j in range(B):
        square = cell[2 * B + j] * cell[2 * B + j] + cell[5 * B + j] * cell[5 * B + j]
        cb, sb = cell[8 * B + j], math.sqrt(square)
        parallel = square < 1e-28  # alpha is then arbitrary, so it is set to zero
        inverse = 1.0 / (1.0 if parallel else sb)
        ca = 1.0 if parallel else -cell[5 * B + j] * inverse
        sa = 0.0 if parallel else cell[2 * B + j] * inverse
        cg, sg = cell[12 * B + j], cell[13 * B + j]
        x, y, z = cell[9 * B + j], cell[10 * B + j], cell[11 * B + j]
        v = ca * y - sa * x
        cell[14 * B + j] = ca * cg - sa * sg
        cell[15 * B + j] = sa * cg + ca * sg
        cell[16 * B + j] = cb
        cell[17 * B + j] = sb
        cell[18 * B + j] = ca * x + sa * y
        cell[19 * B + j] = cb * v + sb * z
        cell[20 * B + j] = ca * cell[j] + sa * cell[3 * B + j]
        cell[21 * B + j] = -(ca * cell[B + j] + sa * cell[4 * B + j])
        cell[22 * B + j] = cb * z - sb * v
        cell[23 * B + j] = ca
        cell[24 * B + j] = sa


@part()
def _begin_slide(state: Floats, axis: int, slide: Floats) -> None:
    """Set a slide to the direction of the frames' coordinate axis."""
    for i in range(3):
        for j in range(BLOCK):
            slide[i, j] = state[3 * i + axis, j]


@part()
def _turn_slide(state: Floats, slide: Floats) -> None:
    """Turn a direction by -alpha, with the cosine and sine from `_decompose`."""
    for j in range(BLOCK):
        x, y, ca, sa = slide[0, j], slide[1, j], state[23, j], state[24, j]
        slide[0, j] = ca * x + sa * y
        slide[1, j] = ca * y - sa * x


@part()
def _segments(
    tree: SegmentTree, angles: Floats, shift: Floats, state: Floats, constants: Floats, slides: Floats
) -> None:
    """Fill the constants and slides of one block; see `reduce_chain`."""
    for j in range(BLOCK):
        constants[len(tree.segment), 6, j] = 1.0  # parent -1 is this last row, as there is no rotation before the base
    number = 0
    for segment in range(len(tree.segment)):
        parent, is_end, first_slide = tree.segment[segment, 1], tree.segment[segment, 2] == 1, tree.segment[segment, 3]
        stop_slide = tree.segment[segment + 1, 3] if segment + 1 < len(tree.segment) else len(slides)
        _begin(state, constants, parent, is_end)
        for _ in range(tree.segment[segment, 0]):
            what, axis, index = tree.instruction[number, 0], tree.instruction[number, 1], tree.instruction[number, 2]
            number += 1
            if what == ROTATE:
                _rotate(state, axis, angles[0, index], angles[1, index])
            elif what == SHIFT:
                _shift(state, axis, shift[index])
            elif what == FIXED:
                _transform(state, tree.fixed[index])
            else:
                _begin_slide(state, axis, slides[first_slide + index])
        if is_end:
            for j in range(BLOCK):
                constants[segment, 4, j] = state[9, j]
                constants[segment, 5, j] = state[10, j]
                constants[segment, 8, j] = state[11, j]
            continue
        _decompose(state.reshape(-1))
        for i in range(9):
            for j in range(BLOCK):
                constants[segment, i, j] = state[14 + i, j]
        for k in range(first_slide, stop_slide):
            _turn_slide(state, slides[k])


@compiled
def reduce_chain(tree: SegmentTree, population: Floats) -> tuple[Floats, Floats]:
    """Reduce the chain for candidates.

    Args:
        tree: transforms.
        population: (candidates, p) searched parameters.

    Returns:
        (blocks, segments + 1, 9, BLOCK) constants, and (blocks, slides, 3, BLOCK) directions of the slides. The
        constants of a joint segment are cosine and sine of alpha and of beta, a, b, cosine and sine of gamma, and d.
        Those of an end segment are the prism's x, y, z at 4, 5 and 8. Copies of the last candidate fill up its block.
    """
    segments, blocks = len(tree.segment), -(-len(population) // BLOCK)
    slide_count = 0
    for k in range(len(tree.instruction)):
        slide_count += tree.instruction[k, 0] == SLIDE
    constants = np.zeros((blocks, segments + 1, 9, BLOCK))
    slides = np.zeros((blocks, slide_count, 3, BLOCK))
    angles = np.empty((2, len(tree.angle), BLOCK))
    shift = np.empty((len(tree.shift), BLOCK))
    state = np.empty((25, BLOCK))
    last = len(population) - 1
    for block in range(blocks):
        first = block * BLOCK
        for k in range(len(tree.angle)):
            for j in range(BLOCK):
                state[0, j] = tree.angle[k] + population[min(first + j, last), tree.angle_parameter[k]]
            _cosines_sines(state[0], angles[0, k], angles[1, k])
        for k in range(len(tree.shift)):
            for j in range(BLOCK):
                shift[k, j] = tree.shift[k] + population[min(first + j, last), tree.shift_parameter[k]]
        _segments(tree, angles, shift, state, constants[block], slides[block])
    return constants, slides
