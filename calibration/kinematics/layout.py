"""Segments of a chain and order of its observations for the compiled fitness.

The transforms of all prisms form a tree with shared beginnings. Observations of several prisms in one pose are
processed together.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.kinematics.chain import Chain, ChainData, Op, X, Y, Z, rotation_about
from calibration.kinematics.chain_reduction import FIXED, ROTATE, SHIFT, SLIDE, Integers, SegmentTree
from calibration.kinematics.population_loops import (
    ADD_ANGLE,
    CHUNK,
    COMPARE,
    FIRST_STEP,
    FIRST_TURN,
    LANES,
    MOVE,
    MOVED_STEP,
    PLACE,
    STEP,
    STEP_MOVE,
    TWO_STEPS,
)
from calibration.observations import Floats


class Layout(NamedTuple):
    """Observations in chunks, and the steps to take for each.

    Attributes:
        todo: (w, 6) code and operands of each step of the compiled function; the steps of a group are consecutive.
        chunk: (c, 4) first and last + 1 entry of `todo`, number of poses (a multiple of `LANES`), first prism slot.
        table: (c * 2 rotations * CHUNK) cosines and sines of the driven angles.
        length: (c * lengths * CHUNK) driven lengths, mm.
        target: (slots * 4 * CHUNK) measured x, y, z relative to the set-up's nominal base, mm, and weight; one slot for
            each prism of a chunk; padded poses have weight 0.
        place: (n) index of the x of each observation in `target`.
        turns, lengths: numbers of distinct driven angles and driven lengths.
    """

    todo: Integers
    chunk: Integers
    table: Floats
    length: Floats
    target: Floats
    place: Integers
    turns: int
    lengths: int


def _integers(rows: Sequence[tuple[int, ...]], columns: int) -> Integers:
    return np.array(rows, dtype=np.intp).reshape(-1, columns)


def _affine(op: Op) -> Floats:
    """Return the matrix (4, 4) of a constant transform."""
    out = np.eye(4)
    if op.rotates:
        out[:3, :3] = rotation_about(op.axis, op.constant)
    else:
        out[op.axis, 3] = op.constant
    return out


class _Index:
    """Numbers of distinct keys, in the order of their first appearance."""

    def __init__(self) -> None:
        self.keys: dict[Any, int] = {}

    def __call__(self, key: Hashable) -> int:
        return self.keys.setdefault(key, len(self.keys))

    def pairs(self) -> tuple[Floats, Integers]:
        """Return keys that are pairs of a constant and a parameter, as two columns."""
        constants = np.array([constant for constant, _ in self.keys], dtype=np.float64)
        return constants, np.array([parameter for _, parameter in self.keys], dtype=np.intp)


@dataclass
class _Segment:
    parent: int
    instruction: list[tuple[int, int, int]] = field(default_factory=list)
    slides: list[int] = field(default_factory=list)
    turn: int = -1


class Planner:
    """Collects the segments of the paths from the base to the prisms, then orders the observations accordingly.

    Args:
        chain: kinematics.
        free: (p,) mask of the parameters that are searched.
        at: (p,) values of the other parameters.
    """

    def __init__(self, chain: Chain, free: NDArray[np.bool_], at: Floats) -> None:
        self._chain = chain
        self._searched = np.where(free, np.cumsum(free) - 1, -1)
        self._at = np.where(free, 0.0, at)
        self._segments: list[_Segment] = []
        self._number: dict[tuple[int, int, tuple[Op, ...]], int] = {}
        self._paths: dict[tuple[int, int], list[int]] = {}
        self._fixed: list[Floats] = []
        self._angles, self._shifts, self._turns, self._lengths = _Index(), _Index(), _Index(), _Index()

    def _path(self, setup: int, prism: int) -> list[int]:
        """Return the segments from a prism back to the base of a set-up."""
        if (setup, prism) in self._paths:
            return self._paths[setup, prism]
        first = self._chain.base_start + 6 * setup
        base = [Op(False, axis, 0.0, first + axis) for axis in (X, Y, Z)]
        base += [Op(True, axis, 0.0, first + 3 + i) for i, axis in enumerate((Z, Y, X))]
        path: list[int] = []
        run: list[Op] = []
        for op in (*base, *self._chain.prism_chain(prism)):
            run.append(self._settled(op))
            if op.rotates and op.drive:
                path.append(self._segment(path, setup, run, len(base)))
                run = []
        path.append(self._segment(path, setup, run, len(base)))
        self._paths[setup, prism] = path[::-1]
        return path[::-1]

    def _settled(self, op: Op) -> Op:
        """Return the transform with the value of its parameter added to the constant if it is not searched."""
        if op.parameter < 0:
            return op
        constant = op.constant + float(self._at[op.parameter])
        return replace(op, constant=constant, parameter=int(self._searched[op.parameter]))

    # Driven rotations are about z in every convention of the rig description, as the reduced steps require.
    def _segment(self, path: list[int], setup: int, run: list[Op], base: int) -> int:
        """Return the number of the segment of `run` that follows `path`; the first `base` transforms are the base's."""
        parent = path[-1] if path else -1
        key = parent, setup, tuple(run)
        if key in self._number:
            return self._number[key]
        segment = _Segment(parent)
        gathered = np.eye(4)
        for i, op in enumerate(run):
            if op.parameter >= 0:
                gathered = self._flush(segment, gathered)
                index = (self._angles if op.rotates else self._shifts)((op.constant, op.parameter))
                segment.instruction.append((ROTATE if op.rotates else SHIFT, op.axis, index))
            else:
                gathered = gathered @ _affine(op)
            if op.drive and op.rotates:
                segment.turn = self._turns(op.drive)
            elif op.drive:
                gathered = self._flush(segment, gathered)
                segment.instruction.append((SLIDE, op.axis, len(segment.slides)))
                segment.slides.append(self._lengths(op.drive))
            if parent < 0 and i == base - 1:
                gathered[:3, :3] = gathered[:3, :3] @ self._chain.placements[self._chain.setups[setup]].rotation
        self._flush(segment, gathered)
        self._number[key] = len(self._segments)
        self._segments.append(segment)
        return self._number[key]

    def _flush(self, segment: _Segment, gathered: Floats) -> Floats:
        """Append the constant transforms gathered so far, and return the identity to gather the next."""
        if not np.array_equal(gathered, np.eye(4)):
            segment.instruction.append((FIXED, 0, len(self._fixed)))
            self._fixed.append(gathered[:3])
        return np.eye(4)

    def _todo(self, setup: int, prisms: Sequence[int]) -> list[tuple[int, ...]]:
        """Return the steps for the poses of a group: driven angles for all prisms, then each prism in turn."""
        todo: list[tuple[int, ...]] = []
        paths = [self._path(setup, prism) for prism in prisms]
        turned = sorted({segment for path in paths for segment in path[1:-1]})
        todo += [(ADD_ANGLE, number, self._segments[self._segments[number].parent].turn) for number in turned]
        for path in paths:
            end, *joints = path
            if joints:
                todo += self._first(end, joints[0])
            else:
                todo += [(PLACE, end), *self._moves(end)]
            at = 1
            while at < len(joints):
                before, segment, *rest = joints[at - 1 :]
                moves = self._moves(segment)
                if moves:
                    todo += [(STEP_MOVE, segment, before, *moves[0][1:]), *moves[1:]]
                elif rest:
                    todo += [(TWO_STEPS, segment, before, rest[0], segment), *self._moves(rest[0])]
                    at += 1
                else:
                    todo.append((STEP, segment, before))
                at += 1
            todo.append((COMPARE, joints[-1] if joints else -1))
        return [(*entry, *(0,) * (6 - len(entry))) for entry in todo]

    def _first(self, end: int, segment: int) -> list[tuple[int, ...]]:
        """Return the steps from a prism's position to the coordinates after the driven rotation nearest to it."""
        turn = self._segments[segment].turn
        moves = self._moves(end)
        if not moves:
            first: list[tuple[int, ...]] = [(FIRST_STEP, segment, turn, end)]
        elif len(moves) == 1:
            first = [(MOVED_STEP, segment, turn, *moves[0][1:], end)]
        else:
            first = [(PLACE, end), *moves, (FIRST_TURN, segment, turn)]
        return first + self._moves(segment)

    def _moves(self, segment: int) -> list[tuple[int, ...]]:
        first = self._first_slide(segment)
        return [(MOVE, first + i, row) for i, row in enumerate(self._segments[segment].slides)]

    def _first_slide(self, segment: int) -> int:
        return sum(len(s.slides) for s in self._segments[:segment])

    def plan(self, data: ChainData, position_mm: Floats, weight: Floats) -> tuple[SegmentTree, Layout]:
        """Order the observations so that prisms measured in one pose share its driven angles.

        Args:
            data: (n) bound observations.
            position_mm: (n, 3) measured positions.
            weight: (n,) weight of each squared error, 1/mm^2.
        """
        groups = list(_groups(data))
        for setup, prisms, _ in groups:
            for prism in prisms:
                self._path(setup, prism)
        todo: list[tuple[int, ...]] = []
        chunks: list[tuple[int, int, int, int]] = []
        rows_of: list[Integers] = []
        slots = 0
        for setup, prisms, rows in groups:
            first = len(todo)
            todo += self._todo(setup, prisms)
            for piece in np.array_split(rows, -(-len(rows) // CHUNK)):
                chunks.append((first, len(todo), -(-len(piece) // LANES) * LANES, slots))
                rows_of.append(piece)
                slots += len(prisms)
        tree = SegmentTree(
            *self._angles.pairs(),
            *self._shifts.pairs(),
            np.array(self._fixed).reshape(-1, 3, 4),
            _integers([i for s in self._segments for i in s.instruction], 3),
            _integers(
                [
                    (len(s.instruction), s.parent, s.turn < 0, self._first_slide(i))
                    for i, s in enumerate(self._segments)
                ],
                4,
            ),
        )
        table, length = self._readings(data, rows_of)
        target, place = self._targets(data, position_mm, weight, rows_of)
        counts = len(self._turns.keys), len(self._lengths.keys)
        return tree, Layout(_integers(todo, 6), _integers(chunks, 4), table, length, target, place, *counts)

    def _readings(self, data: ChainData, chunks: Sequence[Integers]) -> tuple[Floats, Floats]:
        table = np.zeros((len(chunks), len(self._turns.keys), 2, CHUNK))
        table[:, :, 0] = 1.0
        length = np.zeros((len(chunks), len(self._lengths.keys), CHUNK))
        for number, rows in enumerate(chunks):
            readings = data.readings[rows[:, 0]]
            for i, drive in enumerate(self._turns.keys):
                angle = Op(True, Z, drive=drive).driven(readings)
                table[number, i, :, : len(rows)] = np.cos(angle), np.sin(angle)
            for i, drive in enumerate(self._lengths.keys):
                length[number, i, : len(rows)] = Op(False, Z, drive=drive).driven(readings)
        return table.ravel(), length.ravel()

    def _targets(
        self, data: ChainData, position_mm: Floats, weight: Floats, chunks: Sequence[Integers]
    ) -> tuple[Floats, Integers]:
        nominal = np.array([self._chain.placements[setup].translation_mm for setup in self._chain.setups])
        measured = np.column_stack([position_mm - nominal[data.setup], weight]).T
        target = np.zeros((sum(rows.shape[1] for rows in chunks), 4, CHUNK))
        place = np.empty(len(data), dtype=np.intp)
        slots = iter(range(len(target)))
        for rows in chunks:
            for own in rows.T:
                slot = next(slots)
                target[slot, :, : len(own)] = measured[:, own]
                place[own] = 4 * CHUNK * slot + np.arange(len(own))
        return target.ravel(), place


def _groups(data: ChainData) -> Iterator[tuple[int, list[int], Integers]]:
    """Yield groups of poses with the same prisms at one set-up: (set-up, its k prisms, (poses, k) rows of `data`).

    Observations with exactly the same readings at the same set-up are one pose. Repeated measurements of a prism there
    form additional poses.
    """
    n = len(data)
    if n == 0:
        return
    _, standstill = np.unique(np.column_stack([data.setup, data.readings]), axis=0, return_inverse=True)
    order = np.lexsort((data.prism, standstill))
    again = (np.diff(standstill[order]) == 0) & (np.diff(data.prism[order]) == 0)
    first = np.maximum.accumulate(np.where(np.concatenate([[False], again]), 0, np.arange(n)))
    repeat = np.empty(n, dtype=np.intp)
    repeat[order] = np.arange(n) - first
    _, pose = np.unique(np.column_stack([standstill, repeat]), axis=0, return_inverse=True)
    rows = np.full((int(pose.max()) + 1, int(data.prism.max()) + 1), -1, dtype=np.intp)
    rows[pose, data.prism] = np.arange(n)
    setup = np.empty(len(rows), dtype=np.intp)
    setup[pose] = data.setup
    kinds, kind = np.unique(np.column_stack([setup, rows >= 0]), axis=0, return_inverse=True)
    for number, (at, *seen) in enumerate(kinds.tolist()):
        prisms = np.flatnonzero(seen)
        yield at, prisms.tolist(), rows[np.flatnonzero(kind == number)][:, prisms]
