"""Columns of a smooth background: joint errors that depend on angles, and displacements over work volume and time.

A machine has more errors than the library has effects. The remaining errors are smooth: an error of a joint that
depends on its own angle or on those of two neighbours, or a displacement that changes slowly over the work volume or
with time. Each is a block of cosines whose amplitudes are normal with a common scale, smaller for finer waves: a
Gaussian process with few columns (Solin and Särkkä, Statistics and Computing 30, 2020).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.columns import NO_JOINT, EffectColumns, joined
from calibration.effects.context import EffectContext
from calibration.effects.links import Link, own_rows, turning_rows
from calibration.effects.timing import step_grid
from calibration.observations import Floats

_CURVE_WAVES = 10  # half waves over a joint's own reading
_SURFACE_WAVES = 3  # half waves over each of two angles
_PAIR_WAVES = 2  # half waves over each of two readings
_PLACE_WAVES = 2  # half waves over each coordinate
_TIME_WAVES, _MOST_WAVES = 8, 60
_LEAST_TURN_DEG, _LEAST_STROKE_MM = 0.5, 2.0  # smallest range of a joint that gets a curve
_ROWS_PER_WAVE = 8
_WHOLE_TURN_DEG = 300.0  # a wider range counts as a full turn, with periodic waves
_LEAST_NM = 1e-6
_JOINT_SIGMA = {"revolute": 1e-3, "prismatic": 1.0}  # rad or mm


@dataclass(frozen=True)
class Block:
    """One part of the background.

    Attributes:
        name: name of the block.
        kind: `curve`, a function of the joint's own reading; `surface`, a function of two readings; `pair`, `place`,
            `time` for displacements; `event` for a general change at an instant; `drift` for a general slow change with
            time; `elastic` for compliance under loads; `formula`.
        where: the joint that has the error, else `station`.
        text: phrase for output: the variables that the block depends on, or the event.
        columns: columns for the samples; prior sigmas correspond to plausible amplitudes.
        since_s: instant of an event; NaN for other blocks.
    """

    name: str
    kind: str
    where: str
    text: str
    columns: EffectColumns
    since_s: float = math.nan

    @property
    def clause(self) -> str:
        """Clause that describes the block in an answer."""
        return self.text if self.where == "station" else f"{self.where} error by {self.text}"


def smooth_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> tuple[Block, ...]:
    """Return the blocks of the standard background: joint errors, and displacements over place and time.

    Args:
        context: context of n observations.
        average: function from values (n, ...) of rows to values (m, ...) of samples.
    """
    moving = _moving(context)
    curves = [_curve(context, name) for name in moving]
    surfaces = [block for pair in itertools.pairwise(moving) for block in _surfaces(context, average, pair, pair)]
    every = [*(_over(average, curve) for curve in curves), *surfaces, _over(average, _place(context))]
    return (*every, *time_blocks(context, average))


def possible_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> Iterator[Block]:
    """Yield blocks for faster drift, and for errors of any joint and displacements that depend on any two joints.

    Arguments are those of `smooth_blocks`.
    """
    yield from time_blocks(context, average, fine=True)
    moving = _moving(context)
    for pair in itertools.combinations(moving, 2):
        yield from _surfaces(context, average, pair, moving)
    for pair in itertools.combinations(moving, 2):
        yield _over(average, _pair(context, pair))


def displacement_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> tuple[Block, ...]:
    """Return blocks of displacements by pairs of joints; with the smooth blocks they can represent any structure.

    Arguments are those of `smooth_blocks`.
    """
    return tuple(_over(average, _pair(context, pair)) for pair in itertools.pairwise(_moving(context)))


def time_blocks(
    context: EffectContext, average: Callable[[Floats], Floats], *, fine: bool = False
) -> tuple[Block, ...]:
    """Return displacements that vary with time, or with the order of rows where times are not known.

    Args:
        context: context of n observations.
        average: as for `smooth_blocks`.
        fine: True for waves as short as the number of rows allows.
    """
    at = times_or_order(context)
    if len(at) < 4 * _ROWS_PER_WAVE:
        return ()
    number = np.arange(1, (min(len(at) // _ROWS_PER_WAVE, _MOST_WAVES) if fine else _TIME_WAVES) + 1)
    waves = np.cos(np.pi * number * _unit(at)[:, None])
    name = "fine time" if fine else "time"
    block = Block(
        name, "time", "station", "time", _shifts(name, waves, 1.0 / np.sqrt(number) if fine else 1.0 / number)
    )
    return (_over(average, block),)


def event_blocks(
    context: EffectContext, average: Callable[[Floats], Floats], instants_s: Collection[float]
) -> Iterator[Block]:
    """Yield blocks for step changes at an instant: zeros of all joints, and displacements linear in the position.

    Args:
        context: context of n observations.
        average: as for `smooth_blocks`.
        instants_s: instants to try in addition to a grid over the rows, s.
    """
    time_s = context.extra("time_s")
    grid = {step["time_s"] for step in step_grid(time_s)}
    for at_s in sorted(grid | set(instants_s)):
        yield event_block(context, average, time_s, at_s)


def event_block(context: EffectContext, average: Callable[[Floats], Floats], of_row: Floats, border: float) -> Block:
    """Return the block of step changes at a border: zeros of all joints, and displacements linear in the position.

    Args:
        context: context of n observations.
        average: as for `smooth_blocks`.
        of_row: (n,) time in s, or a different variable that orders the rows.
        border: value of `of_row` after which the changes apply.
    """
    name = f"event({border})"
    after = (of_row > border).astype(np.float64)[:, None]
    text = f"more has changed at time_s = {border:g} than one effect explains"
    return Block(name, "event", "station", text, _of_all(context, name, after, np.ones(1)).over(average), border)


def drift_block(context: EffectContext, average: Callable[[Floats], Floats], of_row: Floats) -> Block:
    """Return the block of steady changes: zeros of all joints, and displacements linear in the position.

    Arguments are those of `event_block`.
    """
    t = 2.0 * _unit(of_row) - 1.0
    columns = _of_all(context, "drift", np.stack([t, t * t], axis=1), np.ones(2))
    return Block("drift", "drift", "station", "time, at all joints and all places", columns.over(average))


def elastic_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> tuple[Block, ...]:
    """Return a block for each row that joints turn: compliance of its link and bearing, proportional to the load.

    The row turns about its own axis in proportion to that component of the moment of the weights beyond it, and about
    the perpendicular axes in proportion to the rest. The block of the first row also represents the base.

    Arguments are those of `smooth_blocks`.
    """
    joint_of = {row: joint for joint, row in own_rows(context.rig).items()}
    found = []
    for row in turning_rows(context.rig) if context.rig.masses else ():
        link, where = Link(context, row), joint_of.get(row, f"row{row}")
        moment = link.moment_newton_m
        most = float(np.linalg.norm(moment, axis=1).max(initial=0.0))
        if most < _LEAST_NM or not link.carries_prism.any():
            continue
        about = link.axis * (link.axis * moment).sum(axis=1)[:, None]
        turns = np.stack([about, moment - about], axis=1) * (_JOINT_SIGMA["revolute"] / most)
        arm_mm = (context.located.prism_mm - link.place_mm) * link.carries_prism[:, None]
        shift_mm = context.to_station(np.cross(turns, arm_mm[:, None]).transpose(0, 2, 1))
        name = f"elastic({where})"
        columns = EffectColumns(
            (f"{name}:about", f"{name}:across"), np.full(2, NO_JOINT), np.zeros((len(context), 2)), np.ones(2), shift_mm
        )
        found.append(Block(name, "elastic", where, "load", columns.over(average)))
    return tuple(found)


def times_or_order(context: EffectContext) -> Floats:
    """Return the times (n,) of the rows, or their numbers if some times are not known or all are the same."""
    time_s = context.extra("time_s")
    return time_s if np.isfinite(time_s).all() and np.ptp(time_s) > 0.0 else np.arange(float(len(context)))


def _over(average: Callable[[Floats], Floats], block: Block) -> Block:
    return replace(block, columns=block.columns.over(average))


def _moving(context: EffectContext) -> list[str]:
    return [name for name in context.rig.joint_names if _moves(context, name)]


def _moves(context: EffectContext, joint: str) -> bool:
    least = _LEAST_TURN_DEG if _kind(context, joint) == "revolute" else _LEAST_STROKE_MM
    return float(np.ptp(context.reading(joint))) > least


def _curve(context: EffectContext, joint: str) -> Block:
    most = min(_CURVE_WAVES, max(len(context) // _ROWS_PER_WAVE, 2))
    values, number = _waves(context, joint, most)
    name = f"curve({joint})"
    return Block(name, "curve", joint, joint, _at_joint(context, joint, name, values, 1.0 / number))


def _surfaces(
    context: EffectContext, average: Callable[[Floats], Floats], pair: Sequence[str], joints: Sequence[str]
) -> Iterator[Block]:
    """Yield blocks, for the samples, of errors of some joints that depend on a pair of joints."""
    (a, of_a), (b, of_b) = (_waves(context, name, _SURFACE_WAVES) for name in pair)
    values = average((a[:, :, None] * b[:, None, :]).reshape(len(context), -1))
    sizes = 1.0 / np.hypot(of_a[:, None], of_b).ravel()
    text = " and ".join(pair)
    for joint in joints:
        name = f"surface({text})@{joint}"
        yield Block(name, "surface", joint, text, _at_joint(context, joint, name, values, sizes))


def _pair(context: EffectContext, pair: Sequence[str]) -> Block:
    """Return displacements along the station's axes that depend on two joints."""
    (a, of_a), (b, of_b) = (_waves(context, name, _PAIR_WAVES) for name in pair)
    both = (a[:, :, None] * b[:, None, :]).reshape(len(context), -1)
    sizes = np.concatenate([1.0 / of_a, 1.0 / of_b, 1.0 / np.hypot(of_a[:, None], of_b).ravel()])
    text = " and ".join(pair)
    columns = _shifts(f"pair({text})", np.hstack([a, b, both]), sizes)
    return Block(f"pair({text})", "pair", "station", text, columns)


def _waves(context: EffectContext, joint: str, most: int) -> tuple[Floats, Floats]:
    """Return waves (n, k) of a joint's reading and their numbers (k,): half waves over its range, or waves per turn."""
    reading = context.reading(joint)
    if _kind(context, joint) == "revolute" and np.ptp(reading) > _WHOLE_TURN_DEG:
        number = np.arange(1, most // 2 + 2 if most % 2 else most // 2 + 1)
        angle = np.deg2rad(reading)[:, None] * number
        return np.hstack([np.cos(angle), np.sin(angle)]), np.tile(number, 2).astype(np.float64)
    number = np.arange(1, most + 1)
    return np.cos(np.pi * number * _unit(reading)[:, None]), number.astype(np.float64)


def _kind(context: EffectContext, joint: str) -> str:
    return context.rig.joint(joint).kind


def _place(context: EffectContext) -> Block:
    """Return displacements along three axes that depend on the position of the prism in the work volume."""
    u = [_unit(axis) for axis in context.located.prism_mm.T]
    orders = [order for order in itertools.product(range(_PLACE_WAVES + 1), repeat=3) if any(order)]
    waves = np.stack(
        [np.prod([np.cos(np.pi * k * v) for k, v in zip(order, u, strict=True)], axis=0) for order in orders], axis=1
    )
    sizes = np.array([1.0 / np.linalg.norm(order) for order in orders])
    return Block("place", "place", "station", "place", _shifts("place", waves, sizes))


def _unit(values: Floats) -> Floats:
    """Return values (n,) scaled to the range from 0 to 1."""
    low, high = float(values.min()), float(values.max())
    return (values - low) / max(high - low, 1e-12)


def _of_all(context: EffectContext, name: str, waves: Floats, sizes: Floats) -> EffectColumns:
    """Return zeros of all joints and displacements linear in the position, each times waves (n, k) of sizes (k,)."""
    u = np.stack([np.ones(len(context)), *(2.0 * _unit(axis) - 1.0 for axis in context.located.prism_mm.T)], axis=1)
    places = (waves[:, :, None] * u[:, None, :]).reshape(len(u), -1)
    zeros = [_at_joint(context, joint, name, waves, sizes) for joint in _moving(context)]
    return joined([_shifts(name, places, np.repeat(sizes, u.shape[1])), *zeros], len(context))


def _at_joint(context: EffectContext, joint: str, name: str, values: Floats, sizes: Floats) -> EffectColumns:
    kind = _kind(context, joint)
    unit = math.degrees(1.0) if kind == "revolute" else 1.0
    index = context.chain.joint_index[joint]
    return EffectColumns(
        tuple(f"{name}:{i}" for i in range(len(sizes))),
        np.full(len(sizes), index),
        values * unit,
        sizes * _JOINT_SIGMA[kind],
    )


def _shifts(name: str, waves: Floats, sizes: Floats) -> EffectColumns:
    """Return (n, 3, 3 k) displacements along the station's axes, mm, as waves (n, k) with prior sizes (k,)."""
    shift = np.concatenate([waves[:, None, :] * axis[None, :, None] for axis in np.eye(3)], axis=2)
    count = shift.shape[2]
    return EffectColumns(
        tuple(f"{name}:{i}" for i in range(count)),
        np.full(count, NO_JOINT),
        np.zeros((len(waves), count)),
        np.tile(sizes, 3),
        shift,
    )
