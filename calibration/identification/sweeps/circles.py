"""Axes from circles: while one joint moves and the others stand still, a prism moves on a circle about its axis.

The method of section 3.1 of the first paper. The line of a prismatic joint is treated in the same way. Where a joint
drives several rows (a parallel linkage), the prism still moves on a curve, which the best-fitting circle summarises.
Such a circle is not an axis of the machine, and is only compared with the circle of the model's predicted positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calibration.identification.noise import reading_variance
from calibration.identification.samples import LEAST_STOPS, Samples, standing_spread, stops
from calibration.identification.sweeps.circle_fit import (
    CENTRE,
    DIRECTION,
    TRAVEL,
    Kind,
    SweepCurve,
    fit_curve,
    without_outliers,
)
from calibration.kinematics.chain import Chain, ChainData, Integers
from calibration.observations import Floats
from calibration.rig.description import Joint

_MOST_SWEEPS = 10  # of one joint, prism and set-up
_REACH = 0.75  # of a standing joint's spread: greatest distance from the central row of a group
_LEAST_TURN = np.radians(10.0)
_LEAST_STROKE_MM = 50.0
_WIDEST_STEP = np.radians(150.0)  # beyond it the sense of rotation is ambiguous
_MOST_TILT = np.radians(5.0)  # greatest standard error of a useful direction
_CLEAN = 4.0  # greatest mean square of a clean sweep, relative to the median sweep's


@dataclass(frozen=True)
class Axis:
    """A joint's axis as measured by one sweep of one prism, in the station's frame.

    Attributes:
        joint, setup, prism: names of the sweep's joint, set-up and prism.
        kind: `revolute` for a circle, `prismatic` for a line.
        features: (8,) direction, centre in mm, radius in mm, travel (`circle_fit.SweepCurve`). The direction is that of
            right-handed rotation, or of motion along a line, as readings increase.
        covariance: (8, 8) covariance of the features.
        freedom: degrees of freedom of the covariance.
        sweep: (n) readings at the positions that count, with those of the standing joints at their medians.
    """

    joint: str
    setup: str
    prism: str
    kind: Kind
    features: Floats
    covariance: Floats
    freedom: int
    sweep: ChainData

    @property
    def direction(self) -> Floats:
        """(3,) unit vector."""
        return self.features[DIRECTION]

    @property
    def direction_sigma_rad(self) -> float:
        """Standard error of the direction where it is largest."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[DIRECTION, DIRECTION])[-1]))

    @property
    def centre_mm(self) -> Floats:
        """(3,) centre of the circle or middle of the line."""
        return self.features[CENTRE]

    @property
    def travel(self) -> float:
        """Motion along the curve for each rad or mm of the reading; 1 for a correct encoder."""
        return float(self.features[TRAVEL])


@dataclass(frozen=True)
class _Measured:
    joint: int
    kind: Kind
    sweep: ChainData
    curve: SweepCurve
    variance: Floats  # (n,) mm^2 per axis that the station explains


def find_axes(chain: Chain, samples: Samples) -> tuple[Axis, ...]:
    """Find the axes measured by single-joint sweeps, from the base outwards.

    A sweep is at least five different positions of one joint, seen by one prism at one set-up, while all joints that
    could move that prism stand still within their reading noise. Which joints move the prism, and whether they turn or
    only shift it, follows from the structure of the chain; its parameter values are not used.

    Args:
        chain: kinematics.
        samples: m rows.
    """
    found = [m for sweep in _sweeps(chain, samples) if (m := _measured(chain, samples, *sweep)) is not None]
    if not found:
        return ()
    # All clean sweeps share one scale of the noise; every other sweep has its own.
    own = np.array([_squares(m) / m.curve.freedom for m in found])
    clean = [m for m, scale in zip(found, own, strict=True) if scale <= _CLEAN * np.median(own)]
    freedom = sum(m.curve.freedom for m in clean)
    pooled = max(sum(_squares(m) for m in clean) / freedom, 1e-12)
    axes = [_axis(chain, m, pooled, freedom) for m in found]
    kept = [a for a in axes if a.direction_sigma_rad <= _MOST_TILT]
    first = {name: min(row for row, _, j, _ in chain.rig.couplings() if j == name) for name in chain.rig.joint_names}
    return tuple(sorted(kept, key=lambda a: (first[a.joint], chain.rig.joint_names.index(a.joint))))


def predicted_curve(chain: Chain, x: Floats, axis: Axis) -> SweepCurve:
    """Return the curve of the same sweep that the kinematics predict at `x` (p,)."""
    places = chain.positions_mm(x, axis.sweep)
    return fit_curve(axis.kind, places, joint_values(chain, axis.joint, axis.sweep))


def drives_several(chain: Chain, axis: Axis) -> bool:
    """Return True if the joint drives several rows before the prism, so that its circle is about no axis of the rig."""
    prism, joint = chain.rig.prism_names.index(axis.prism), chain.rig.joint_names.index(axis.joint)
    return sum(driven == joint for op in chain.prism_chain(prism) for driven, _ in op.drive) > 1


# -- sweeps ----------------------------------------------------------------------------------------------------------


def _sweeps(chain: Chain, samples: Samples) -> Iterator[tuple[int, Kind, Integers]]:
    """Yield the joint, kind of curve and rows of every sweep."""
    spread = standing_spread(chain.rig)
    data = samples.data
    for setup, prism in np.unique(np.column_stack([data.setup, data.prism]), axis=0).tolist():
        rows = np.flatnonzero((data.setup == setup) & (data.prism == prism))
        ops = [op for op in chain.prism_chain(prism) if op.drive]
        movers = sorted({joint for op in ops for joint, _ in op.drive})
        for joint in movers:
            turns = any(op.rotates for op in ops for driven, _ in op.drive if driven == joint)
            others = [j for j in movers if j != joint]
            for standing in _standing(data.readings[rows][:, others] / spread[others]):
                yield joint, "revolute" if turns else "prismatic", rows[standing]


def _standing(values: Floats) -> Iterator[Integers]:
    """Yield the largest groups of five or more rows that agree in every column of `values` (n, k), in spreads."""
    if values.shape[1] == 0:
        yield np.arange(len(values))
        return
    near = np.asarray(cKDTree(values).query_ball_point(values, _REACH, p=np.inf, return_length=True))
    taken = np.zeros(len(values), dtype=bool)
    found = 0
    for row in np.argsort(-near, kind="stable").tolist():
        if near[row] < LEAST_STOPS or found == _MOST_SWEEPS:
            return
        if taken[row]:
            continue
        group = np.flatnonzero(~taken & (np.abs(values - values[row]) <= _REACH).all(axis=1))
        taken[group] = True
        if len(group) >= LEAST_STOPS:
            found += 1
            yield group


def _measured(chain: Chain, samples: Samples, joint: int, kind: Kind, rows: Integers) -> _Measured | None:
    rig = chain.rig
    name, spread = rig.joint_names[joint], standing_spread(rig)[joint]
    variance = np.trace(samples.station_covariance[rows], axis1=1, axis2=2) / 3.0
    order = np.argsort(samples.data.readings[rows, joint], kind="stable")
    rows, variance = rows[order], variance[order]
    # The pose of the joint while others are swept occurs many times, but must count as one position only.
    stop = stops(samples.data.readings[rows, joint], float(spread))
    readings, variance = _medians(samples.data.readings[rows, joint], stop), _medians(variance, stop)
    if not _enough(rig.joint(name), readings):
        return None
    places = _medians(samples.position_mm[rows], stop)
    kept = without_outliers(kind, places, float(np.sqrt(np.median(variance))))
    if not _enough(rig.joint(name), readings[kept]):
        return None
    level = np.tile(np.median(samples.data.readings[rows], axis=0), (int(kept.sum()), 1))
    level[:, joint] = readings[kept]
    first = rows[: len(level)]
    sweep = ChainData(level, samples.data.prism[first], samples.data.setup[first])
    curve = fit_curve(kind, places[kept], joint_values(chain, name, sweep))
    return _Measured(joint, kind, sweep, curve, variance[kept])


def _medians(values: Floats, stop: Integers) -> Floats:
    """Return medians of the rows (n, ...) of each stop."""
    return np.array([np.median(values[stop == i], axis=0) for i in range(int(stop[-1]) + 1)])


def _enough(joint: Joint, readings: Floats) -> bool:
    """Return True if ascending readings are many and far enough, without a step of ambiguous sense of rotation."""
    if len(readings) < LEAST_STOPS:
        return False
    steps = np.diff(readings)
    if joint.kind == "prismatic":
        return bool(np.ptp(readings) >= _LEAST_STROKE_MM)
    return bool(np.radians(np.ptp(readings)) >= _LEAST_TURN and np.radians(steps.max()) <= _WIDEST_STEP)


def joint_values(chain: Chain, joint: str, sweep: ChainData) -> Floats:
    """Return the (n,) readings of a joint in a sweep, rad or mm."""
    readings = sweep.readings[:, chain.rig.joint_names.index(joint)]
    return np.radians(readings) if chain.rig.joint(joint).kind == "revolute" else readings


def _squares(measured: _Measured) -> float:
    return float((measured.curve.distance_mm**2 / measured.variance).sum())


def _axis(chain: Chain, measured: _Measured, pooled: float, freedom: int) -> Axis:
    curve, joint = measured.curve, chain.rig.joints[measured.joint]
    scale = max(pooled, _squares(measured) / curve.freedom)
    weighted = curve.sensitivity * (scale * measured.variance)[:, None]
    covariance = np.tensordot(weighted, curve.sensitivity, axes=([1, 2], [1, 2]))
    values = joint_values(chain, joint.name, measured.sweep)
    sigma = float(np.sqrt(reading_variance(chain.rig)[measured.joint]))
    read = np.radians(sigma) if joint.kind == "revolute" else sigma
    covariance[TRAVEL, TRAVEL] += (curve.features[TRAVEL] * read) ** 2 / float(((values - values.mean()) ** 2).sum())
    return Axis(
        joint=joint.name,
        setup=chain.setups[int(measured.sweep.setup[0])],
        prism=chain.rig.prism_names[int(measured.sweep.prism[0])],
        kind=measured.kind,
        features=curve.features,
        covariance=covariance,
        freedom=freedom,
        sweep=measured.sweep,
    )
