"""Compiled fitness of whole populations of candidate parameters.

A chain's elementary transforms are merged into steps (one rotation preceded by one translation) and applied from the
prism back to the base, so that each observation costs six multiplications a step. Sines and cosines of the readings
are computed once; a candidate's angle enters by angle addition, outside the loop over observations. The compiled
function releases the interpreter's lock and starts no threads, so that islands run it side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from calibration.kinematics import Chain, ChainData, Op
from calibration.observations import Floats

Integers = NDArray[np.intp]
_F = TypeVar("_F", bound=Callable[..., Any])

_CHUNK = 256  # observations whose coordinates stay in the first-level cache
_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}  # not nnan: a candidate that overflows must stay visible


def _compiled(function: _F) -> _F:
    """Compile on first call, kept on disk where numba finds a writable place, in memory alone where it does not."""
    try:
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy", cache=True)(function))
    except RuntimeError:  # numba: no locator available
        return cast("_F", numba.njit(nogil=True, fastmath=_FASTMATH, error_model="numpy")(function))


@_compiled
def _angle_addition(u: Floats, v: Floats, c0: float, s0: float, cosines: Floats, sines: Floats) -> None:
    """Turn the coordinates u, v (n,) by the driven angles plus the angle of cosine c0 and sine s0."""
    for m in range(len(u)):
        c = cosines[m] * c0 - sines[m] * s0
        s = sines[m] * c0 + cosines[m] * s0
        old = u[m]
        u[m] = c * old - s * v[m]
        v[m] = s * old + c * v[m]


@_compiled
def _turn(u: Floats, v: Floats, c: float, s: float) -> None:
    """Turn the coordinates u, v (n,) by one angle."""
    for m in range(len(u)):
        old = u[m]
        u[m] = c * old - s * v[m]
        v[m] = s * old + c * v[m]


@_compiled
def _translate(w: Floats, shift: float, driven: int, length: Floats, start: int) -> None:
    """Move the coordinates w (n,) by `shift` and, where `driven` >= 0, by that row of `length`."""
    if driven >= 0:
        lengths = length[driven, start:]
        for m in range(len(w)):
            w[m] += shift + lengths[m]
    elif shift != 0.0:
        for m in range(len(w)):
            w[m] += shift


@_compiled
def _bases(x: Floats, rotation: Floats, translation: Floats, base_start: int, pose: Floats) -> None:
    """Trans(x, y, z) Rot(z) Rot(y) Rot(x) times every placement: pose (setups, 3, 4)."""
    for b in range(len(rotation)):
        first = base_start + 6 * b
        cz, sz = math.cos(x[first + 3]), math.sin(x[first + 3])
        cy, sy = math.cos(x[first + 4]), math.sin(x[first + 4])
        cx, sx = math.cos(x[first + 5]), math.sin(x[first + 5])
        for j in range(3):
            r0, r1, r2 = rotation[b, 0, j], rotation[b, 1, j], rotation[b, 2, j]
            r1, r2 = cx * r1 - sx * r2, sx * r1 + cx * r2
            r2, r0 = cy * r2 - sy * r0, sy * r2 + cy * r0
            r0, r1 = cz * r0 - sz * r1, sz * r0 + cz * r1
            pose[b, 0, j], pose[b, 1, j], pose[b, 2, j] = r0, r1, r2
            pose[b, j, 3] = translation[b, j] + x[first + j]


@_compiled
def _squares(
    work: Floats, pose: Floats, target: Floats, weight: Floats, start: int, n: int, inverse_scale: float
) -> float:
    """Sum of robust weighted squared distances of the placed points from the targets start .. start + n."""
    w0, w1, w2 = work[0], work[1], work[2]
    g0, g1, g2 = target[0, start:], target[1, start:], target[2, start:]
    weights = weight[start:]
    total = 0.0
    for m in range(n):
        e0 = pose[0, 0] * w0[m] + pose[0, 1] * w1[m] + pose[0, 2] * w2[m] + pose[0, 3] - g0[m]
        e1 = pose[1, 0] * w0[m] + pose[1, 1] * w1[m] + pose[1, 2] * w2[m] + pose[1, 3] - g1[m]
        e2 = pose[2, 0] * w0[m] + pose[2, 1] * w1[m] + pose[2, 2] * w2[m] + pose[2, 3] - g2[m]
        square = weights[m] * (e0 * e0 + e1 * e1 + e2 * e2)
        total += square / (1.0 + square * inverse_scale)
    return total


@_compiled
def _fitness(
    population: Floats,
    step_axis: Integers,
    step_angle: Floats,
    step_angle_parameter: Integers,
    step_driven_angle: Integers,
    step_length: Floats,
    step_length_parameter: Integers,
    step_driven_length: Integers,
    block_start: Integers,
    block_steps: Integers,
    block_setup: Integers,
    base_rotation: Floats,
    base_translation: Floats,
    base_start: int,
    cosine: Floats,
    sine: Floats,
    length: Floats,
    target: Floats,
    weight: Floats,
    inverse_scale: float,
    out: Floats,
) -> None:
    """Fitness of every candidate; a block is a run of observations of one prism at one set-up."""
    steps = len(step_axis)
    c_step, s_step = np.empty(steps), np.empty(steps)
    shift = np.empty((steps, 3))
    pose = np.empty((len(base_rotation), 3, 4))
    work = np.empty((3, np.max(np.diff(block_start))))
    for candidate in range(len(population)):
        x = population[candidate]
        for k in range(steps):
            angle = step_angle[k] + (x[step_angle_parameter[k]] if step_angle_parameter[k] >= 0 else 0.0)
            c_step[k], s_step[k] = math.cos(angle), math.sin(angle)
            for i in range(3):
                parameter = step_length_parameter[k, i]
                shift[k, i] = step_length[k, i] + (x[parameter] if parameter >= 0 else 0.0)
        _bases(x, base_rotation, base_translation, base_start, pose)
        out[candidate] = 0.0
        for block in range(len(block_setup)):
            start = block_start[block]
            n = block_start[block + 1] - start
            for i in range(3):
                work[i, :n] = 0.0
            for k in range(block_steps[block, 0], block_steps[block, 1]):
                axis, driven = step_axis[k], step_driven_angle[k]
                if axis >= 0:
                    u, v = work[(axis + 1) % 3, :n], work[(axis + 2) % 3, :n]
                    if driven >= 0:
                        _angle_addition(u, v, c_step[k], s_step[k], cosine[driven, start:], sine[driven, start:])
                    else:
                        _turn(u, v, c_step[k], s_step[k])
                for i in range(3):
                    _translate(work[i, :n], shift[k, i], step_driven_length[k, i], length, start)
            out[candidate] += _squares(work, pose[block_setup[block]], target, weight, start, n, inverse_scale)


@dataclass
class _Step:
    """Applied to a point: rotate (if `axis` >= 0), then translate."""

    axis: int = -1
    angle: float = 0.0
    angle_parameter: int = -1
    driven_angle: int = -1
    length: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    length_parameter: list[int] = field(default_factory=lambda: [-1, -1, -1])
    driven_length: list[int] = field(default_factory=lambda: [-1, -1, -1])


class _Driven:
    """Sizes of the driven transforms, one row per distinct transform."""

    def __init__(self, readings: Floats) -> None:
        self._readings = readings
        self._index: dict[Op, int] = {}
        self._sizes: list[Floats] = []

    def add(self, op: Op) -> int:
        if op not in self._index:
            self._index[op] = len(self._sizes)
            self._sizes.append(op.driven(self._readings))
        return self._index[op]

    def table(self) -> Floats:
        return np.array(self._sizes).reshape(len(self._sizes), len(self._readings))


def _steps(ops: Sequence[Op], angles: _Driven, lengths: _Driven) -> Iterator[_Step]:
    """Merge the transforms, from the prism back to the base."""
    step = _Step()
    for op in reversed(ops):
        if op.rotates:
            yield step
            step = _Step(op.axis, op.constant, op.parameter)
            if op.drive:
                step.angle, step.driven_angle = 0.0, angles.add(op)
            continue
        taken = (op.parameter >= 0 and step.length_parameter[op.axis] >= 0) or (
            op.drive and step.driven_length[op.axis] >= 0
        )
        if taken:
            yield step
            step = _Step()
        if op.parameter >= 0:
            step.length_parameter[op.axis] = op.parameter
        if op.drive:
            step.driven_length[op.axis] = lengths.add(op)
        else:
            step.length[op.axis] += op.constant
    yield step


@dataclass(frozen=True)
class Fitness:
    """Weighted sum of squared position errors of every candidate of a population; picklable, callable.

    Called with (candidates, p) parameters, it returns (candidates,) sums of weight * |error|^2, or with `robust_scale`
    c of u / (1 + u / c^2), u = weight * |error|^2 (Geman-McClure), which no gross outlier dominates.
    """

    arguments: tuple[Any, ...]
    inverse_scale: float

    @classmethod
    def build(
        cls, chain: Chain, data: ChainData, position_mm: Floats, weight: Floats, robust_scale: float = math.inf
    ) -> Fitness:
        """Prepare the observations.

        Args:
            chain: kinematics.
            data: (n) bound observations.
            position_mm: (n, 3) measured positions.
            weight: (n,) weight of each squared error, 1/mm^2.
            robust_scale: c, in units of sqrt(weight) * mm; infinity for plain squares.
        """
        order = np.lexsort((data.setup, data.prism))
        data = data.select(order)
        angles, lengths = _Driven(data.readings), _Driven(data.readings)
        steps: list[_Step] = []
        span: dict[int, tuple[int, int]] = {}
        for prism in np.unique(data.prism).tolist():
            first = len(steps)
            steps += list(_steps(chain.prism_chain(prism), angles, lengths))
            span[prism] = first, len(steps)
        edges = np.flatnonzero((np.diff(data.prism) != 0) | (np.diff(data.setup) != 0)) + 1
        starts: list[int] = []
        for begin, end in zip([0, *edges.tolist()], [*edges.tolist(), len(data)], strict=True):
            starts += range(begin, end, _CHUNK)
        driven = angles.table()
        placements = [chain.placements[s] for s in chain.setups]

        def column(values: Sequence[Any]) -> Integers:
            return np.array(values, dtype=np.intp)

        arguments = (
            column([s.axis for s in steps]),
            np.array([s.angle for s in steps]),
            column([s.angle_parameter for s in steps]),
            column([s.driven_angle for s in steps]),
            np.array([s.length for s in steps]),
            column([s.length_parameter for s in steps]),
            column([s.driven_length for s in steps]),
            column([*starts, len(data)]),
            column([span[p] for p in data.prism[starts].tolist()]),
            data.setup[starts],
            np.array([p.rotation for p in placements]),
            np.array([p.translation_mm for p in placements]),
            chain.base_start,
            np.cos(driven),
            np.sin(driven),
            lengths.table(),
            np.ascontiguousarray(position_mm[order].T),
            np.ascontiguousarray(weight[order]),
        )
        return cls(arguments, 0.0 if math.isinf(robust_scale) else 1.0 / robust_scale**2)

    def __call__(self, population: Floats) -> Floats:
        out = np.empty(len(population))
        candidates = np.ascontiguousarray(population, dtype=np.float64)
        _fitness(*(candidates, *self.arguments, self.inverse_scale, out))
        return out
