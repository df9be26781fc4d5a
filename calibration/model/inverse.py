"""Inverse of a calibrated model: joint values to command for target positions of prisms.

Newton's method on the whole model. The Jacobian of the kinematics is exact; that of effects and learned residual is by
differences over a thousandth of each joint's range, which smooths the steps of trees. A boom has more joints than a
target has coordinates; of all joint values that bring the prisms to their targets, the step selects those nearest the
nominal command, with distances in ranges of the joints: d = d_0 + A+ (e - A d_0), where A is the Jacobian in these
units, without joints at their limits (active set). Where the step would not bring the prisms nearer, it is damped as by
Levenberg and Marquardt. Only the branch of solutions at the nominal command is searched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DataError
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor, check_setups
from calibration.model.warnings import model_warnings
from calibration.observations import Floats, Observations

Integers = NDArray[np.intp]
Flags = NDArray[np.bool_]

CLOSURE_MM = 0.01  # a target is reached if the model's prism is nearer than this

_CLOSE_MM = 1e-3  # goal of the iterations
_STILL = 1e-5  # in ranges of the joints; smaller moves towards the nominal command are negligible
_NO_STEP = 1e-9  # in ranges of the joints
_LONGEST = 0.1  # greatest step, in the same unit
_DIFFERENCE = 1e-3  # of a joint's range
_STIFF, _SOFT = 1e-6, 1e-12  # of the largest eigenvalue of A A'; directions with smaller ones are not used
_ROUNDS, _SOFT_ROUNDS, _DAMPED_ROUNDS = 8, 16, 50
_FIRST_DAMPING = 1e-3  # of the largest eigenvalue
_LEAST_GAIN = 1e-3  # of the distance; a pose that gains less for `_PATIENCE` rounds is final
_PATIENCE = 4
_STUCK_MM = 1.0  # below this distance, steps of the learned residual may keep a pose from its target
_NUDGES = (3e-3, 1e-2, 3e-2)  # in ranges of the joints
_CHORDS = 8
_TOGETHER = 500  # poses


@dataclass(frozen=True)
class Inverse:
    """Joint values that bring prisms to their targets.

    Attributes:
        observations: the given rows with the joint values to command.
        closure_mm: (n,) distance between each target and its prism, as predicted by the model for these values.
        warnings: warnings about targets out of reach, and about using the model for these commands.
    """

    observations: Observations
    closure_mm: Floats
    warnings: tuple[str, ...]

    @property
    def reached(self) -> Flags:
        """(n,) True for targets reached to 0.01 mm."""
        return self.closure_mm <= CLOSURE_MM


def inverse(model: CalibratedModel, targets: Observations) -> Inverse:
    """Find the joint values for which the model predicts the prisms at their targets.

    Rows of one session, set-up and pose are one pose and are solved together: two prisms on a feed determine its
    attitude. Where the targets of a pose cannot all be reached within the limits of the joints, the pose gets as near
    as possible (least squares over its rows), and the closures give the remaining distances.

    Args:
        model: the model, of which effects and residual are inverted as well. Columns that they need are taken from the
            rows.
        targets: n rows. Their positions are the targets of the prisms, in the frame of their set-up's station, as the
            station would measure them and `predict` returns them, including systematic errors of fixes. Their joints
            are the nominal command, at which the search starts and to which the result stays as near as possible.

    Raises:
        DataError: a row has no position or a joint value that is not finite, or rows of one pose have different
            commands.
        UnsafeError: the model does not know a set-up.
    """
    check_setups(model, targets)
    poses = _poses(targets)
    _check(model, targets, poses)
    joints = np.array([targets.joints[name] for name in model.rig.joint_names]).T.copy()
    closure = np.empty(len(targets))
    for size in sorted({len(rows) for rows in poses}):
        together = np.array([rows for rows in poses if len(rows) == size], dtype=np.intp)
        for first in range(0, len(together), _TOGETHER):
            rows = together[first : first + _TOGETHER]
            found = _Search(model, targets, rows).run()
            joints[rows] = found.readings[:, None, :]
            closure[rows] = np.linalg.norm(found.error.reshape(len(rows), size, 3), axis=2)
    commanded = replace(targets, joints=dict(zip(model.rig.joint_names, joints.T.copy(), strict=True)))
    warnings = (*_out_of_reach(model, commanded, closure, poses), *model_warnings(model, commanded))
    return Inverse(commanded, closure, warnings)


@dataclass
class _State:
    """Poses during the search.

    Attributes:
        readings: (p, joints) deg or mm.
        error: (p, 3 m) vectors from the prisms to their targets, mm.
        slope: (p, 3 m, joints) derivatives of the prisms, mm per range of each joint.
    """

    readings: Floats
    error: Floats
    slope: Floats

    def select(self, rows: Flags | Integers) -> _State:
        return _State(self.readings[rows], self.error[rows], self.slope[rows])

    def take(self, rows: Flags | Integers, other: _State) -> None:
        """Replace these rows by the poses of another state."""
        self.readings[rows], self.error[rows], self.slope[rows] = other.readings, other.error, other.slope

    @property
    def distance(self) -> Floats:
        """(p,) root of the summed squared errors of all prisms of a pose, mm."""
        size: Floats = np.sqrt((self.error**2).sum(axis=1))
        return size


class _Search:
    """Search for the joint values of p poses of m rows each.

    Args:
        model: the model to invert.
        targets: all rows.
        rows: (p, m) row numbers of each pose.
    """

    def __init__(self, model: CalibratedModel, targets: Observations, rows: Integers) -> None:
        self._predictor: Predictor = Predictor.of(model)
        self._names = model.rig.joint_names
        self._targets, self._rows = targets, rows
        self._low, self._high = np.array([joint.limits for joint in model.rig.joints], dtype=np.float64).T
        self._range = self._high - self._low
        self._bends = bool(model.effects) or model.residual is not None
        self._nominal = np.array([targets.joints[name][rows[:, 0]] for name in self._names]).T
        self._wanted = targets.position_mm[rows].reshape(len(rows), -1)

    def run(self) -> _State:
        """Solve all poses."""
        every = np.arange(len(self._rows))
        state = self._at(every, np.clip(self._nominal, self._low, self._high))
        self._freely(every, state, _STIFF, _ROUNDS)
        if self._bends and self._rows.shape[1] > 1:
            self._freely(self._far(state), state, _SOFT, _SOFT_ROUNDS)
        for pose in self._far(state).tolist() if self._bends else ():
            if state.distance[pose] < _STUCK_MM:
                self._nudge(pose, state)
        self._damped(self._far(state), state)
        return state

    @staticmethod
    def _far(state: _State) -> Integers:
        return np.flatnonzero(state.distance > _CLOSE_MM)

    def _freely(self, moving: Integers, state: _State, rank: float, rounds: int) -> None:
        """Take Newton steps, even if they increase the distance, and keep the nearest state of each pose.

        This is enough for most poses. The distance between prisms on one body, however, is fixed except for the
        learned residual. To close such a small error the joints have to move far, along a curve from which straight
        steps deviate. Then steps along the curve (small `rank`) alternate with steps back to it, and neither leads
        towards the nominal command.
        """
        now = state.select(moving)
        for _ in range(rounds):
            along = (now.distance < _STUCK_MM) | (rank == _STIFF)
            step, home = self._step(
                moving, now, np.zeros(len(moving)), along.astype(float), np.where(along, rank, _STIFF)
            )
            closed = (now.distance <= _CLOSE_MM) & (np.abs(home).max(axis=1, initial=0.0) < _STILL)
            going = ~closed & (np.abs(step).max(axis=1, initial=0.0) > _NO_STEP)
            moving, now, step = moving[going], now.select(going), step[going]
            if len(moving) == 0:
                break
            step *= np.minimum(1.0, _LONGEST / np.abs(step).max(axis=1))[:, None]
            now = self._at(moving, np.clip(now.readings + step * self._range, self._low, self._high))
            better = (now.distance <= _CLOSE_MM) | (now.distance < state.distance[moving])
            state.take(moving[better], now.select(better))

    def _damped(self, moving: Integers, state: _State) -> None:
        """Take damped steps (Levenberg and Marquardt) as long as they bring the prisms nearer."""
        damping, ease = np.zeros(len(self._rows)), np.ones(len(self._rows))
        idle = np.zeros(len(self._rows), dtype=np.intp)
        for _ in range(_DAMPED_ROUNDS):
            if len(moving) == 0:
                break
            now = state.select(moving)
            step, _ = self._step(moving, now, damping[moving], ease[moving], np.full(len(moving), _SOFT))
            reached = self._at(moving, np.clip(now.readings + step * self._range, self._low, self._high))
            before, after = now.distance, reached.distance
            better = after < before
            state.take(moving[better], reached.select(better))
            largest = np.square(now.slope).sum(axis=(1, 2))
            worse, good = moving[~better], moving[better]
            damping[worse] = np.maximum(10.0 * damping[worse], _FIRST_DAMPING * largest[~better])
            damping[good] *= np.where(damping[good] > _SOFT * largest[better], 0.1, 0.0)
            ease[worse] *= 0.25
            ease[good] = np.minimum(4.0 * ease[good], 1.0)
            idle[moving] = np.where(before - after > _LEAST_GAIN * before, 0, idle[moving] + 1)
            moving = moving[(idle[moving] < _PATIENCE) & (state.distance[moving] > _CLOSE_MM)]

    def _at(self, poses: Integers, readings: Floats) -> _State:
        """Evaluate poses at readings (p, joints)."""
        p, m, joints = len(poses), self._rows.shape[1], len(self._names)
        moved = readings[:, None, :]
        if self._bends:
            moved = moved + np.vstack([np.zeros(joints), np.diag(_DIFFERENCE * self._range)])
        parts = self._predictor.parts(self._observations(self._rows[poses], moved))
        position = parts.position_mm.reshape(p, -1, m, 3)
        kinematics = parts.joint_jacobian.reshape(p, -1, m, 3, joints)[:, 0]
        if self._bends:
            true = parts.readings.reshape(p, -1, m, joints)[:, :, 0]
            added = parts.correction_mm.reshape(p, -1, m, 3)
            per_range = (true[:, 1:] - true[:, :1]).transpose(0, 2, 1) / _DIFFERENCE
            slope = kinematics @ per_range[:, None]
            slope += (added[:, 1:] - added[:, :1]).transpose(0, 2, 3, 1) / _DIFFERENCE
        else:
            slope = kinematics * self._range
        error = self._wanted[poses] - position[:, 0].reshape(p, -1)
        return _State(readings, error, slope.reshape(p, 3 * m, joints))

    def _observations(self, rows: Integers, readings: Floats) -> Observations:
        """Return the rows (p, m) of each pose at readings (p, k, joints); the prism's index varies fastest."""
        p, k, joints = readings.shape
        m = rows.shape[1]
        index = np.broadcast_to(rows[:, None, :], (p, k, m)).reshape(-1)
        table = np.broadcast_to(readings[:, :, None, :], (p, k, m, joints)).reshape(-1, joints)
        found = self._targets.select(index)
        return replace(found, joints=dict(zip(self._names, table.T.copy(), strict=True)))

    def _step(self, poses: Integers, now: _State, damping: Floats, ease: Floats, rank: Floats) -> tuple[Floats, Floats]:
        """Return the (p, joints) step within the limits, in ranges, and its part towards the nominal command."""
        away = (now.readings - self._nominal[poses]) / self._range
        low, high = (self._low - now.readings) / self._range, (self._high - now.readings) / self._range
        step, home = _least_change(now.slope, now.error, away, damping, ease, rank)
        for i in np.flatnonzero(((step < low) | (step > high)).any(axis=1)).tolist():
            one = slice(i, i + 1)
            pose = now.slope[one], now.error[one], away[one], damping[one], ease[one], rank[one]
            step[i], home[i] = _within(*pose, low[i], high[i])
        return step, home

    def _nudge(self, pose: int, state: _State) -> None:
        """Try starts next to a pose, along the null space, if steps of the residual keep it from its target."""
        one = np.array([pose])
        slope = state.slope[pose]
        _, size, rows = np.linalg.svd(slope)
        free = rows[int((size**2 > _STIFF * size[0] ** 2).sum()) :]
        back = np.linalg.pinv(slope, rcond=_STIFF**0.5)
        for nudge in _NUDGES if len(free) else ():
            start = state.readings[pose] + nudge * np.vstack([free, -free]) * self._range
            readings = np.clip(start, self._low, self._high)
            for chord in range(_CHORDS):
                parts = self._predictor.parts(self._observations(self._rows[one], readings[None]))
                error = self._wanted[one] - parts.position_mm.reshape(len(readings), -1)
                closed = np.sqrt((error**2).sum(axis=1)) <= _CLOSE_MM
                if closed.any() or chord == _CHORDS - 1:
                    break
                readings = np.clip(readings + error @ back.T * self._range, self._low, self._high)
            if closed.any():
                change = np.square((readings - self._nominal[pose]) / self._range).sum(axis=1)
                best = int(np.argmin(np.where(closed, change, np.inf)))
                state.readings[pose], state.error[pose] = readings[best], error[best]
                return


def _least_change(
    slope: Floats, error: Floats, away: Floats, damping: Floats, ease: Floats, rank: Floats
) -> tuple[Floats, Floats]:
    """Compute the damped step towards the targets and, perpendicular to it, towards the nominal command.

    Args:
        slope: (p, 3 m, joints) A.
        error: (p, 3 m) e.
        away: (p, joints) distance from the nominal command.
        damping: (p,) term added to the eigenvalues of A A'.
        ease: (p,) share of the way towards the nominal command to take.
        rank: (p,) least eigenvalue, relative to the largest, of directions to use.

    Returns:
        The step (p, joints), and its part (p, joints) that does not move the prisms.
    """
    turned = slope.transpose(0, 2, 1)
    size, axes = np.linalg.eigh(slope @ turned)
    seen = size > rank[:, None] * size[:, -1:]
    inside = np.where(seen, size, 1.0)
    into = axes.transpose(0, 2, 1)
    towards = np.where(seen, (into @ error[:, :, None])[:, :, 0] / (inside + damping[:, None]), 0.0)
    across = np.where(seen, (into @ (slope @ away[:, :, None]))[:, :, 0] / inside, 0.0)
    home = -ease[:, None] * (away - (turned @ (axes @ across[:, :, None]))[:, :, 0])
    return (turned @ (axes @ towards[:, :, None]))[:, :, 0] + home, home


def _within(
    slope: Floats,
    error: Floats,
    away: Floats,
    damping: Floats,
    ease: Floats,
    rank: Floats,
    low: Floats,
    high: Floats,
) -> tuple[Floats, Floats]:
    """Compute the step as `_least_change` for a single pose, between bounds (joints,) of the step (active set).

    The multiplier of a joint held at its bound shows whether releasing it would bring the prisms nearer or reduce the
    change.
    """
    held = np.zeros(len(low), dtype=bool)
    step, home = np.zeros(len(low)), np.zeros(len(low))
    for _ in range(3 * len(low)):
        at_bound = np.where(held, step, 0.0)
        free_slope = np.where(held, 0.0, slope)
        left = error - slope[0] @ at_bound
        found, across = _least_change(free_slope, left, np.where(held, 0.0, away), damping, ease, rank)
        step, home = at_bound + found[0], across[0]
        outside = ~held & ((step < low) | (step > high))
        if outside.any():
            held |= outside
            step = np.clip(step, low, high)
            continue
        pull = _multiplier(slope[0], free_slope[0], rank[0], left[0] - free_slope[0] @ found[0], away[0] + step)
        wrong = held & (((step >= high) & (pull > 0.0)) | ((step <= low) & (pull < 0.0)))
        if not wrong.any():
            break
        held[int(np.argmax(np.where(wrong, np.abs(pull), -1.0)))] = False
    return np.clip(step, low, high), home


def _multiplier(slope: Floats, free_slope: Floats, rank: float, left: Floats, change: Floats) -> Floats:
    """Return the (joints,) derivative by each joint of the remaining error or, if there is none, of the change."""
    by_miss = -slope.T @ left
    if np.abs(by_miss).max() > 1e-6 * np.square(slope).sum():
        return by_miss
    force = np.linalg.pinv(free_slope.T, rcond=rank**0.5) @ change
    return change - slope.T @ force


def _check(model: CalibratedModel, targets: Observations, poses: list[list[int]]) -> None:
    """Raise DataError for rows with missing numbers, and for poses with different commands."""
    if len(targets) == 0:
        raise DataError("targets", "there are none")
    if not np.isfinite(targets.position_mm).all():
        raise DataError("targets", "every row needs a position", column="x_mm")
    for name, values in targets.joints.items():
        if not np.isfinite(values).all():
            raise DataError("targets", "every row needs the nominal command of every joint", column=name)
    for rows in poses:
        for joint in model.rig.joints if len(rows) > 1 else ():
            values = targets.joints[joint.name][rows]
            if np.ptp(values) > 0.0:
                raise DataError(
                    "targets",
                    f"the rows of pose {str(targets.pose[rows[0]])!r} give {values.min():g} and {values.max():g} "
                    f"{joint.unit}; rows of one pose are solved together and need the same nominal command",
                    column=joint.column,
                )


def _poses(targets: Observations) -> list[list[int]]:
    """Return the rows of each pose, in the order of their first rows."""
    labels = zip(targets.session.tolist(), targets.setup.tolist(), targets.pose.tolist(), strict=True)
    poses: dict[tuple[str, str, str] | int, list[int]] = {}
    for row, label in enumerate(labels):
        poses.setdefault(label if label[2] else row, []).append(row)
    return list(poses.values())


def _out_of_reach(
    model: CalibratedModel, commanded: Observations, closure_mm: Floats, poses: list[list[int]]
) -> Iterator[str]:
    missed = closure_mm > CLOSURE_MM
    if missed.any():
        worst = int(np.argmax(closure_mm))
        most, joints = max(len(rows) for rows in poses if missed[rows].any()), len(model.rig.joints)
        asked = f"; {most} prisms of one pose have {3 * most} coordinates for {joints} joints"
        yield (
            f"{int(missed.sum())} of {len(missed)} targets are out of reach from their nominal commands, within the "
            f"limits of the joints: they are missed by up to {closure_mm[worst]:.3g} mm, in {commanded.row_name(worst)}"
            f"{asked if 3 * most > joints else ''}"
        )
    position = None
    for rows in poses:
        if len(rows) == 1 or not missed[rows].any():
            continue
        position = Predictor.of(model).predict(commanded).position_mm if position is None else position
        first, second = rows[:2]
        wanted, there = (
            float(np.linalg.norm(places[first] - places[second])) for places in (commanded.position_mm, position)
        )
        if abs(wanted - there) > closure_mm[rows].max():
            yield (
                f"pose {str(commanded.pose[first])!r}: the targets of {commanded.prism[first]} and "
                f"{commanded.prism[second]} are {wanted:.2f} mm apart and the prisms are {there:.2f} mm: both cannot "
                f"be reached"
            )
