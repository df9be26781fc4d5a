"""Samples of a fit: averages of the repeated fixes of a standstill, each with its measurement covariance.

Fixes of one session, set-up, pose and prism are repeats. Averaging them lowers that part of the noise of station and
readings that is visible in their scatter. The remaining part is common to a standstill: no number of repeats averages
it out, and that of the readings also affects the other prisms of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.noise import (
    covariance_by_joints,
    joint_rates,
    reading_variance,
    station_covariance,
    timing_covariance,
)
from calibration.kinematics.chain import Chain, ChainData
from calibration.observations import Floats, Observations, originals
from calibration.rig.description import Rig
from calibration.rig.limits import turns_deg

Integers = NDArray[np.intp]

LEAST_STOPS = 5  # of a joint that is swept while the others stand still

_LEAST_REPEATS = 10  # degrees of freedom below which the scatter of repeats is too uncertain to use
_REPEAT_LIMIT = 6.0  # sigma; a repeat farther from its standstill's median is a sample of its own
_SPREAD = 10.0  # sigma between the lowest and the highest of a few thousand readings of one value
_GREATEST_LEVERAGE = 0.95  # the linearised fit is not reliable beyond it


@dataclass(frozen=True)
class Samples:
    """Rows of a fit.

    Attributes:
        data: (m) readings, prisms and set-ups; readings are means over each sample's fixes.
        position_mm: (m, 3) mean position in the station's frame.
        station_covariance: (m, 3, 3) covariance of that mean, mm^2, without readings, timing and excess.
        rates: (m, joints) deg/s or mm/s at the fix, 0 where not measured.
        of_row: (n,) sample that each observation is part of; a copy belongs to the sample of its original.
        repeat_variance: variance of repeats in excess of the station's covariance, mm^2 per axis.
        fixes: (m,) number of observations averaged in each sample.
        reading_scatter: (joints,) variance of readings among repeats, deg^2 or mm^2; 0 if there are too few repeats.
        standstill: (m,) number of the standstill. Samples with the same number share those random errors of their
            readings that repeats do not show.
        unknown_variance: (m, joints) variance of readings due to effects whose inputs are unknown, deg^2 or mm^2, which
            all samples of a standstill share; None for none.
    """

    data: ChainData
    position_mm: Floats
    station_covariance: Floats
    rates: Floats
    of_row: Integers
    repeat_variance: float
    fixes: Floats
    reading_scatter: Floats
    standstill: Integers
    unknown_variance: Floats | None = None

    def __len__(self) -> int:
        return len(self.data)

    def select(self, rows: Integers | NDArray[np.bool_]) -> Samples:
        """Return samples by mask or index, each as a separate standstill with a single observation."""
        data = self.data.select(rows)
        return replace(
            self,
            data=data,
            position_mm=self.position_mm[rows],
            station_covariance=self.station_covariance[rows],
            rates=self.rates[rows],
            of_row=np.arange(len(data)),
            fixes=self.fixes[rows],
            standstill=np.arange(len(data)),
            unknown_variance=None if self.unknown_variance is None else self.unknown_variance[rows],
        )

    def average(self, values: Floats) -> Floats:
        """Return (m, ...) means of `values` (n, ...) over the observations of each sample."""
        return _averages(self.of_row, values)

    def shared_variance(self, rig: Rig) -> Floats:
        """Return the (m, joints) variance of readings that is common to all samples of a standstill, deg^2 or mm^2."""
        shared: Floats = np.maximum(reading_variance(rig) - self.reading_scatter, 0.0)
        return np.tile(shared, (len(self), 1)) if self.unknown_variance is None else shared + self.unknown_variance

    def own_variance(self, rig: Rig) -> Floats:
        """Return the (m, joints) variance of each sample's mean readings without the shared part, deg^2 or mm^2."""
        own: Floats = np.minimum(reading_variance(rig), self.reading_scatter) / self.fixes[:, None]
        return own

    def own_covariance(self, rig: Rig, joint_jacobian: Floats) -> Floats:
        """Return the (m, 3, 3) covariance without the part shared by a standstill, mm^2; arguments as `covariance`."""
        readings = covariance_by_joints(joint_jacobian, self.own_variance(rig))
        return self.station_covariance + readings + timing_covariance(rig, joint_jacobian, self.rates)

    def covariance(self, rig: Rig, joint_jacobian: Floats) -> Floats:
        """Return the (m, 3, 3) covariance of positions due to station, readings and timing of the fix, mm^2.

        Args:
            rig: gives the random errors of readings and timing.
            joint_jacobian: (m, 3, joints) mm per deg or mm.
        """
        shared = covariance_by_joints(joint_jacobian, self.shared_variance(rig))
        return shared + self.own_covariance(rig, joint_jacobian)

    def variance(self, rig: Rig, joint_jacobian: Floats) -> float:
        """Return the mean variance of a coordinate without unknown effects, mm^2; arguments as `covariance`."""
        known = replace(self, unknown_variance=None).covariance(rig, joint_jacobian)
        return float(np.trace(known, axis1=1, axis2=2).mean()) / 3.0


def averaged(chain: Chain, observations: Observations) -> Samples:
    """Average the repeats of every standstill; repeats that disagree become separate samples, copies count once.

    Raises:
        DataError: the chain lacks a prism or set-up of the observations.
    """
    rig, turns = chain.rig, turns_deg(chain.rig)
    distinct, original = np.unique(originals(observations), return_inverse=True)
    observations = observations.select(distinct)
    data = chain.bind(observations)
    position = observations.position_mm
    covariance = station_covariance(rig, position, observations.sigma_mm)
    of_row, squares, freedom = _group_repeats(rig, turns, observations, data.readings, covariance)
    count = np.bincount(of_row)
    expected = np.trace(covariance, axis1=1, axis2=2).mean() / 3.0
    within = squares / (3.0 * freedom) if freedom >= _LEAST_REPEATS else expected
    repeat_variance = max(0.0, within - expected)
    common = max(0.0, 1.0 - within / expected)

    first = np.unique(of_row, return_index=True)[1]
    start = data.readings[first][of_row]
    readings = start + _differences(turns, data.readings - start)
    mean = _averages(of_row, readings)
    scatter = ((readings - mean[of_row]) ** 2).sum(axis=0) / max(freedom, 1)
    means = ChainData(mean, data.prism[first], data.setup[first])
    return Samples(
        data=means,
        position_mm=_averages(of_row, position),
        station_covariance=_averages(of_row, covariance + repeat_variance * np.eye(3))
        * (common + (1.0 - common) / count)[:, None, None],
        rates=_averages(of_row, joint_rates(rig, observations)),
        of_row=of_row[original],
        repeat_variance=float(repeat_variance),
        fixes=count.astype(float),
        reading_scatter=scatter if freedom >= _LEAST_REPEATS else np.zeros_like(scatter),
        standstill=_standstills(rig, turns, observations.select(first), means, count),
    )


def _averages(of_row: Integers, values: Floats) -> Floats:
    order = np.argsort(of_row, kind="stable")
    first = np.flatnonzero(np.diff(of_row[order], prepend=-1))
    if len(first) == len(order):
        return np.ascontiguousarray(values) if (np.diff(order) > 0).all() else values[order]
    count = np.diff(first, append=len(order)).reshape(-1, *([1] * (values.ndim - 1)))
    averages: Floats = np.add.reduceat(values[order], first, axis=0) / count
    return averages


def _differences(turns: Floats, change: Floats) -> Floats:
    """Return (n, joints) changes of readings, deg or mm, modulo whole turns where `turns` (joints,) is positive."""
    return np.where(turns > 0.0, (change + 180.0) % 360.0 - 180.0, change)


def _group_repeats(
    rig: Rig, turns: Floats, observations: Observations, readings: Floats, covariance: Floats
) -> tuple[Integers, float, int]:
    """Group the repeats of each prism and standstill.

    A row whose position or joints disagree with the others of its standstill becomes a separate sample: their mean
    would be a position, or a joint value, that never occurred.

    Returns:
        Sample of every row, sum of squared deviations within samples, and its degrees of freedom.
    """
    position_mm = observations.position_mm
    from_middle = standing_spread(rig) / 2.0
    columns = (observations.session, observations.setup, observations.pose, observations.prism)
    members: dict[tuple[str, ...] | int, list[int]] = {}
    for row, key in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        members.setdefault(key if key[2] else row, []).append(row)
    of_row = np.empty(len(observations), dtype=np.intp)
    following, squares, freedom = 0, 0.0, 0
    for rows in members.values():
        together = np.array(rows)
        if len(rows) > 1:
            distance = np.linalg.norm(position_mm[rows] - np.median(position_mm[rows], axis=0), axis=1)
            sigma = np.sqrt(np.trace(covariance[rows], axis1=1, axis2=2))
            # Both of two repeats are equally far from their median, so only with more may the spread widen the limit.
            spread = 3.0 * np.median(distance) if len(rows) > 2 else 0.0
            agrees = distance <= np.maximum(_REPEAT_LIMIT * sigma, spread)
            change = _differences(turns, readings[rows] - readings[rows[0]])
            agrees &= (np.abs(change - np.median(change, axis=0)) <= from_middle).all(axis=1)
            alone = together[~agrees]
            of_row[alone] = following + np.arange(len(alone))
            following += len(alone)
            together = together[agrees]
        if len(together) == 0:
            continue
        of_row[together] = following
        following += 1
        squares += float(((position_mm[together] - position_mm[together].mean(axis=0)) ** 2).sum())
        freedom += len(together) - 1
    return of_row, squares, freedom


def _standstills(rig: Rig, turns: Floats, observations: Observations, means: ChainData, count: Integers) -> Integers:
    """Return the (m,) number of each sample's standstill.

    A standstill has at most one sample of a prism, as a second one is a repeat that disagreed. Where poses have no
    names, rows with identical readings of all joints are one standstill.

    Args:
        rig: gives the spread of readings at a standstill.
        turns: (joints,) whole turn of each joint, deg, or 0.
        observations: m rows, one of each sample.
        means: the samples' mean readings.
        count: (m,) number of observations in each sample.
    """
    spread = standing_spread(rig)
    found = np.arange(len(means), dtype=np.intp)
    begun: dict[tuple[str, str, str], list[tuple[int, Floats, set[int]]]] = {}
    # Samples with most repeats first, so that a single outlying repeat cannot found a standstill that others join.
    for sample in np.argsort(-count, kind="stable").tolist():
        prism, readings = int(means.prism[sample]), means.readings[sample]
        pose = str(observations.pose[sample]) or readings.tobytes().hex()
        key = str(observations.session[sample]), str(observations.setup[sample]), pose
        for number, first, prisms in begun.setdefault(key, []):
            if prism not in prisms and (np.abs(_differences(turns, readings - first)) <= spread).all():
                prisms.add(prism)
                found[sample] = number
                break
        else:
            begun[key].append((sample, readings, {prism}))
    return found


# -- standing joints ---------------------------------------------------------------------------------------------------


def standing_spread(rig: Rig) -> Floats:
    """Return the (joints,) largest difference of two readings of a joint that did not move, deg or mm."""
    return np.array([_SPREAD * joint.sigma + 2.0 * joint.resolution for joint in rig.joints])


def stops(readings: Floats, spread: float) -> Integers:
    """Return the (n,) number of the stop, from 0, to which each of a joint's ascending readings (n,) belongs.

    `spread` is that joint's `standing_spread`.
    """
    out = np.zeros(len(readings), dtype=np.intp)
    first = readings[0]
    for i in range(1, len(readings)):
        new = readings[i] - first > spread
        first = readings[i] if new else first
        out[i] = out[i - 1] + new
    return out


# -- leave one out -----------------------------------------------------------------------------------------------------


def left_out_errors(
    rig: Rig,
    samples: Samples,
    error_mm: Floats,
    jacobian: Floats,
    joint_jacobian: Floats,
    covariance: Floats,
    excess_variance: float,
    groups: Integers | None = None,
) -> Floats:
    """Estimate the errors that samples would have if their group had been left out of the fit.

    A fit follows each of its samples a little. In the fit linearised at its solution, the errors e of a group become
    V (V - J C J')^-1 e when the group is left out (leave-one-out residuals, Cook & Weisberg 1982, extended to blocks
    and a prior). V is the noise of the group, J are its derivatives and C is the posterior covariance.

    Args:
        rig: gives the random errors of readings and of the timing of a fix.
        samples: m rows of the fit.
        error_mm: (m, 3) errors of the fit, or what a further model leaves of them.
        jacobian: (m, 3, p) derivatives by everything that was fitted.
        joint_jacobian: (m, 3, joints) mm per deg or mm.
        covariance: (p, p) posterior covariance.
        excess_variance: variance of the samples in excess of station and readings, mm^2 per axis.
        groups: (m,) group number of each sample; by default its standstill.

    Returns:
        (m, 3) errors, mm.
    """
    own = samples.own_covariance(rig, joint_jacobian) + excess_variance * np.eye(3)
    by_reading = joint_jacobian * np.sqrt(samples.shared_variance(rig))[:, None, :]
    out = np.empty_like(error_mm)
    block = samples.standstill if groups is None else groups
    order = np.argsort(block, kind="stable")
    first, size = np.unique(block[order], return_index=True, return_counts=True)[1:]
    for k in np.unique(size):
        rows = order[first[size == k][:, None] + np.arange(k)]  # (blocks, k)
        flat = (len(rows), 3 * k, -1)
        shared = by_reading[rows].reshape(flat)
        still = samples.standstill[rows]
        together = np.repeat(np.repeat(still[:, :, None] == still[:, None, :], 3, axis=1), 3, axis=2)
        noise = shared @ shared.transpose(0, 2, 1) * together
        for i in range(k):
            noise[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += own[rows[:, i]]
        factor = np.linalg.cholesky(noise)
        whitened = np.linalg.solve(factor, jacobian[rows].reshape(flat))
        taken = (whitened.reshape(-1, len(covariance)) @ covariance).reshape(flat)
        leverage, axes = np.linalg.eigh(taken @ whitened.transpose(0, 2, 1))
        error = np.linalg.solve(factor, error_mm[rows].reshape(flat))
        grown = 1.0 / (1.0 - np.clip(leverage, 0.0, _GREATEST_LEVERAGE))
        left = factor @ (axes @ (grown[:, :, None] * (axes.transpose(0, 2, 1) @ error)))
        out[rows] = left.reshape(len(rows), k, 3)
    return out
