"""Columns of a smooth unknown: joint errors that depend on angles, and displacements over the work volume and time.

A machine has more than a library has names for. What is left of it is smooth: an error of a joint that depends on its
own angle or on those of two neighbours, a displacement that changes slowly over the work volume or with time. Each of
these is a block of cosines whose amounts are normal with a standard deviation of their own, smaller for finer waves: a
Gaussian process of few columns (Solin and Särkkä, Statistics and Computing 30, 2020).
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

_CURVE_WAVES = 10  # half waves of a joint's own reading
_SURFACE_WAVES = 3  # of each of two angles
_PAIR_WAVES = 2  # of each of two readings
_PLACE_WAVES = 2  # of each coordinate
_TIME_WAVES, _MOST_WAVES = 8, 60
_LEAST_TURN_DEG, _LEAST_STROKE_MM = 0.5, 2.0  # a joint that moves less has no curve
_ROWS_PER_WAVE = 8
_WHOLE_TURN_DEG = 300.0  # who covers more meets himself at the other end, or nearly
_LEAST_NM = 1e-6
_JOINT_SIGMA = {"revolute": 1e-3, "prismatic": 1.0}  # rad or mm


@dataclass(frozen=True)
class Block:
    """One part of the background.

    Attributes:
        name: of the block.
        kind: `curve` of a joint's own reading, `surface` of two; `pair`, `place`, `time` for displacements; `event` for
            all that is another from an instant on, `drift` for all that changes slowly with time; `elastic` for all
            that gives way to loads; `formula`.
        where: the joint that errs, else `station`.
        text: on what it depends, or what has happened, for people.
        columns: of the samples; prior sigmas are those of amounts of plausible size.
        since_s: instant of an event; NaN for all others.
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
    """Return the blocks beside which names are sought: errors of joints, and what wanders over place and time.

    Args:
        context: of n observations.
        average: makes values (m, ...) of samples from values (n, ...) of rows.
    """
    moving = _moving(context)
    curves = [_curve(context, name) for name in moving]
    surfaces = [block for pair in itertools.pairwise(moving) for block in _surfaces(context, average, pair, pair)]
    every = [*(_over(average, curve) for curve in curves), *surfaces, _over(average, _place(context))]
    return (*every, *time_blocks(context, average))


def possible_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> Iterator[Block]:
    """Yield what any two joints may do together, errors of every joint and displacements, and what wanders faster.

    Arguments are those of `smooth_blocks`.
    """
    yield from time_blocks(context, average, fine=True)
    moving = _moving(context)
    for pair in itertools.combinations(moving, 2):
        yield from _surfaces(context, average, pair, moving)
    for pair in itertools.combinations(moving, 2):
        yield _over(average, _pair(context, pair))


def displacement_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> tuple[Block, ...]:
    """Return blocks of displacements by pairs of joints: together with the smooth ones they see any structure.

    Arguments are those of `smooth_blocks`.
    """
    return tuple(_over(average, _pair(context, pair)) for pair in itertools.pairwise(_moving(context)))


def time_blocks(
    context: EffectContext, average: Callable[[Floats], Floats], *, fine: bool = False
) -> tuple[Block, ...]:
    """Return displacements that wander with time, or with the order of rows where no time is known.

    Args:
        context: of n observations.
        average: as of `smooth_blocks`.
        fine: with as short waves as so many rows can show.
    """
    time_s = context.extra("time_s")
    at = time_s if np.isfinite(time_s).all() and np.ptp(time_s) > 0.0 else np.arange(float(len(context)))
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
    """Yield what may be another from an instant on: zeros of all joints, and displacements linear in the place.

    Args:
        context: of n observations.
        average: as of `smooth_blocks`.
        instants_s: to look at beside those of a grid over the rows.
    """
    time_s = context.extra("time_s")
    grid = {step["time_s"] for step in step_grid(time_s)}
    for at_s in sorted(grid | set(instants_s)):
        yield event_block(context, average, time_s, at_s)


def event_block(context: EffectContext, average: Callable[[Floats], Floats], of_row: Floats, border: float) -> Block:
    """Return what may be another beyond a border: zeros of all joints, and displacements linear in the place.

    Args:
        context: of n observations.
        average: as of `smooth_blocks`.
        of_row: (n,) time in s, or whatever else the rows are ordered by.
        border: of it.
    """
    name = f"event({border})"
    after = (of_row > border).astype(np.float64)[:, None]
    text = f"more has changed at time_s = {border:g} than one effect says"
    return Block(name, "event", "station", text, _of_all(context, name, after, np.ones(1)).over(average), border)


def drift_block(context: EffectContext, average: Callable[[Floats], Floats], of_row: Floats) -> Block:
    """Return what may change steadily: zeros of all joints, and displacements linear in the place.

    Arguments are those of `event_block`.
    """
    t = 2.0 * _unit(of_row) - 1.0
    columns = _of_all(context, "drift", np.stack([t, t * t], axis=1), np.ones(2))
    return Block("drift", "drift", "station", "time, at all joints and all places", columns.over(average))


def elastic_blocks(context: EffectContext, average: Callable[[Floats], Floats]) -> tuple[Block, ...]:
    """Return what links and bearings do that give way in proportion to load, a block for each row that joints turn.

    It turns a little further about its axis by the moment of the weights beyond about it, and about the axes across by
    the rest of that moment. The first of them is also what the base does.

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
    """Yield errors of some joints that depend on two, of the samples."""
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
    """Return waves (n, k) of a joint's reading and their numbers (k,): half waves of its range, or whole ones."""
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
    """Return displacements that depend on the place of the prism in the work volume, along three axes."""
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
    """Return zeros of all joints and displacements linear in the place, each times waves (n, k) of sizes (k,)."""
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
    """Return (n, 3, 3 k) displacements along the station's axes, mm, by waves (n, k) of sizes (k,)."""
    shift = np.concatenate([waves[:, None, :] * axis[None, :, None] for axis in np.eye(3)], axis=2)
    count = shift.shape[2]
    return EffectColumns(
        tuple(f"{name}:{i}" for i in range(count)),
        np.full(count, NO_JOINT),
        np.zeros((len(waves), count)),
        np.tile(sizes, 3),
        shift,
    )
