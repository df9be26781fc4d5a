"""Axes from circles: while one joint moves and the others stand, its prism runs on a circle about the joint's axis.

The first paper's section 3.1. A prismatic joint's line is treated likewise. Where a joint drives several rows (a
parallel linkage) the prism still runs on a curve, and the circle that fits it best is a summary of it; such circles are
never taken for an axis of the machine, only held against the circle that fits the model's own places of that sweep.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from calibration.identification.refinement import prior_precision
from calibration.identification.samples import Samples, reading_variance
from calibration.identification.standing import standing_spread
from calibration.identification.start import rigid_fit, rough_start
from calibration.identification.sweeps.circle_fit import (
    CENTRE,
    DIRECTION,
    FEATURES,
    RADIUS,
    TRAVEL,
    Curve,
    Kind,
    fit_curve,
    without_outliers,
)
from calibration.kinematics import Chain, ChainData, Integers, Placement
from calibration.observations import Floats
from calibration.rig import Joint

_LEAST_PLACES = 5
_MOST_SWEEPS = 10  # of one joint, prism and set-up
_REACH = 0.75  # of the spread, about a row in the middle of its group
_LEAST_TURN = np.radians(10.0)
_LEAST_STROKE_MM = 50.0
_WIDEST_STEP = np.radians(150.0)  # beyond it the sense of turning is a guess
_MOST_TILT = np.radians(5.0)  # standard error of a direction that is worth having
_CLEAN = 4.0  # a sweep's mean square over the median sweep's
_FAR_PRIOR = 100.0  # build tolerances within which a far start may lie, 1 sigma
_INNER_ROUNDS, _LAST_ROUNDS = 10, 40
_FLOOR_RAD, _FLOOR_MM = np.radians(0.2), 5.0  # weights of a start: no axis counts more than it needs to


@dataclass(frozen=True)
class Axis:
    """A joint's axis as one sweep of one prism shows it, in the station's frame.

    Attributes:
        joint, setup, prism: whose sweep it is.
        kind: `revolute` for a circle, `prismatic` for a line.
        features: (8,) direction, centre in mm, radius in mm, travel (`circle_fit.Curve`): direction by the right-hand
            rule, or the way of travel, as readings grow.
        covariance: (8, 8) of the features.
        arc: rad or mm along the curve.
        rms_mm: distance of the places from the curve.
        freedom: degrees of freedom behind the covariance.
        sweep: (n) readings of the places that count, those of the standing joints at their medians.
        outliers: how many places were left out.
    """

    joint: str
    setup: str
    prism: str
    kind: Kind
    features: Floats
    covariance: Floats
    arc: float
    rms_mm: float
    freedom: int
    sweep: ChainData
    outliers: int

    @property
    def direction(self) -> Floats:
        """(3,) unit vector."""
        return self.features[DIRECTION]

    @property
    def direction_sigma_rad(self) -> float:
        """Standard error of the direction, its worst way."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[DIRECTION, DIRECTION])[-1]))

    @property
    def centre_mm(self) -> Floats:
        """(3,) centre of the circle or middle of the line."""
        return self.features[CENTRE]

    @property
    def radius_mm(self) -> float:
        """Radius; 0 for a line."""
        return float(self.features[RADIUS])

    @property
    def radius_sigma_mm(self) -> float:
        """Standard error of the radius."""
        return float(np.sqrt(self.covariance[RADIUS, RADIUS]))

    @property
    def travel(self) -> float:
        """How far it moves along the curve for each rad or mm that its reading grows; 1 for a sound encoder."""
        return float(self.features[TRAVEL])

    @property
    def arc_deg(self) -> float:
        """How far the circle was followed; 0 for a line."""
        return float(np.degrees(self.arc)) if self.kind == "revolute" else 0.0


@dataclass(frozen=True)
class _Measured:
    joint: int
    kind: Kind
    sweep: ChainData
    curve: Curve
    variance: Floats  # (n,) mm^2 per axis that the station explains
    outliers: int


def find_axes(chain: Chain, samples: Samples) -> tuple[Axis, ...]:
    """The axes that single-joint sweeps show, from the base outwards.

    A sweep is at least five different positions of one joint, seen by one prism at one set-up, while all joints that
    could move that prism stand still within their reading noise. What moves, turns or only shifts the prism is taken
    from the chain's structure; its numbers play no part.

    Args:
        chain: kinematics.
        samples: m rows.
    """
    found = [m for sweep in _sweeps(chain, samples) if (m := _measured(chain, samples, *sweep)) is not None]
    if not found:
        return ()
    # One scale of the noise for all sweeps that are clean curves; any other has its own.
    own = np.array([_squares(m) / m.curve.freedom for m in found])
    clean = [m for m, scale in zip(found, own, strict=True) if scale <= _CLEAN * np.median(own)]
    freedom = sum(m.curve.freedom for m in clean)
    pooled = max(sum(_squares(m) for m in clean) / freedom, 1e-12)
    axes = [_axis(chain, m, pooled, freedom) for m in found]
    kept = [a for a in axes if a.direction_sigma_rad <= _MOST_TILT]
    first = {name: min(row for row, _, j, _ in chain.rig.couplings() if j == name) for name in chain.rig.joint_names}
    return tuple(sorted(kept, key=lambda a: (first[a.joint], chain.rig.joint_names.index(a.joint))))


def predicted_curve(chain: Chain, x: Floats, axis: Axis) -> Curve:
    """The curve of the same sweep as the kinematics at `x` (p,) have it."""
    places = chain.positions_mm(x, axis.sweep)
    return fit_curve(axis.kind, places, _values(chain, axis.joint, axis.sweep))


def drives_several(chain: Chain, axis: Axis) -> bool:
    """Whether the joint moves the prism in several places at once, so that its circle is about no axis of the rig."""
    prism, joint = chain.rig.prism_names.index(axis.prism), chain.rig.joint_names.index(axis.joint)
    return sum(driven == joint for op in chain.prism_chain(prism) for driven, _ in op.drive) > 1


def start_from_axes(chain: Chain, samples: Samples, axes: Sequence[Axis], *, prior_scale: float = _FAR_PRIOR) -> Floats:
    """Parameters that bring the model's axes and circles onto the measured ones: a start for the refinement.

    Directions depend on angles alone, and hardly on one another's errors: base and angles are fitted to them first,
    joints from the base outwards; then lengths to the centres and radii as well. Where a prism is on its circle takes
    no part, so an angle that turns no measured axis stays at its prior.

    Args:
        chain: kinematics with its bases placed anyhow.
        samples: the rows, for set-ups without sweeps.
        axes: of `find_axes`, at least one.
        prior_scale: width of the prior in build tolerances; the default lets angles be tens of degrees off.

    Returns:
        (p,) parameters.

    Raises:
        UnsafeError: a set-up without sweeps whose fixes cannot place its base.
    """
    precision = prior_precision(chain, prior_scale)
    x = np.zeros(len(chain))
    seen = sorted({chain.setups.index(axis.setup) for axis in axes})
    for setup in seen:
        _turn_base(chain, x, setup, [a for a in axes if a.setup == chain.setups[setup]])
    angles = np.array([p.unit == "rad" and p.kind != "prism" for p in chain.parameters])
    # The circle of a joint that drives several rows may flip over while their axes are far from where they belong.
    single = [a for a in axes if not drives_several(chain, a)] or list(axes)
    joints = list(dict.fromkeys(axis.joint for axis in single))
    for count in range(1, len(joints) + 1):
        inner = [a for a in single if a.joint in joints[:count]]
        x = _settle(chain, x, inner, angles, precision, directions_only=True)
    for setup in seen:
        own = [a for a in axes if a.setup == chain.setups[setup]]
        shift = [a.centre_mm - predicted_curve(chain, x, a).features[CENTRE] for a in own]
        x[chain.base_index(setup)][:3] += np.median(shift, axis=0)
    everything = np.ones(len(chain), dtype=bool)
    x = _settle(chain, x, single, everything, precision, directions_only=False)
    if len(single) < len(axes):
        x = _settle(chain, x, list(axes), everything, precision, directions_only=False)
    return _place_others(chain, samples, x, seen)


# -- sweeps ----------------------------------------------------------------------------------------------------------


def _sweeps(chain: Chain, samples: Samples) -> Iterator[tuple[int, Kind, Integers]]:
    """Every joint with the rows of one of its sweeps."""
    spread = standing_spread(chain.rig)
    data = samples.data
    for setup in np.unique(data.setup):
        for prism in np.unique(data.prism):
            rows = np.flatnonzero((data.setup == setup) & (data.prism == prism))
            ops = [op for op in chain.prism_chain(int(prism)) if op.drive]
            movers = sorted({joint for op in ops for joint, _ in op.drive})
            for joint in movers:
                turns = any(op.rotates for op in ops for driven, _ in op.drive if driven == joint)
                others = [j for j in movers if j != joint]
                for standing in _standing(data.readings[rows][:, others] / spread[others]):
                    yield joint, "revolute" if turns else "prismatic", rows[standing]


def _standing(values: Floats) -> Iterator[Integers]:
    """The largest few groups of rows (n, k) that agree in every column, at least five in each; 1 is their spread."""
    if values.shape[1] == 0:
        yield np.arange(len(values))
        return
    near = np.asarray(cKDTree(values).query_ball_point(values, _REACH, p=np.inf, return_length=True))
    taken = np.zeros(len(values), dtype=bool)
    found = 0
    for row in np.argsort(-near, kind="stable").tolist():
        if near[row] < _LEAST_PLACES or found == _MOST_SWEEPS:
            return
        if taken[row]:
            continue
        group = np.flatnonzero(~taken & (np.abs(values - values[row]) <= _REACH).all(axis=1))
        taken[group] = True
        if len(group) >= _LEAST_PLACES:
            found += 1
            yield group


def _measured(chain: Chain, samples: Samples, joint: int, kind: Kind, rows: Integers) -> _Measured | None:
    rig = chain.rig
    name, spread = rig.joint_names[joint], standing_spread(rig)[joint]
    variance = np.trace(samples.station_covariance[rows], axis1=1, axis2=2) / 3.0
    order = np.argsort(samples.data.readings[rows, joint], kind="stable")
    rows, variance = rows[order], variance[order]
    # The pose in which the joint stands while others are swept comes again and again: one place, not most of them.
    stop = _stops(samples.data.readings[rows, joint], float(spread))
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
    curve = fit_curve(kind, places[kept], _values(chain, name, sweep))
    return _Measured(joint, kind, sweep, curve, variance[kept], int((~kept).sum()))


def _stops(readings: Floats, spread: float) -> Integers:
    """(n,) number of the stop that each of the rising readings belongs to."""
    out = np.zeros(len(readings), dtype=np.intp)
    first = readings[0]
    for i in range(1, len(readings)):
        new = readings[i] - first > spread
        first = readings[i] if new else first
        out[i] = out[i - 1] + new
    return out


def _medians(values: Floats, stop: Integers) -> Floats:
    """Medians of the rows (n, ...) of each stop."""
    return np.array([np.median(values[stop == i], axis=0) for i in range(int(stop[-1]) + 1)])


def _enough(joint: Joint, readings: Floats) -> bool:
    """Whether rising readings have enough places, reach and no step so wide that the way round is a guess."""
    if len(readings) < _LEAST_PLACES:
        return False
    steps = np.diff(readings)
    if joint.kind == "prismatic":
        return bool(np.ptp(readings) >= _LEAST_STROKE_MM)
    return bool(np.radians(np.ptp(readings)) >= _LEAST_TURN and np.radians(steps.max()) <= _WIDEST_STEP)


def _values(chain: Chain, joint: str, sweep: ChainData) -> Floats:
    """(n,) readings of the joint, rad or mm."""
    readings = sweep.readings[:, chain.rig.joint_names.index(joint)]
    return np.radians(readings) if chain.rig.joint(joint).kind == "revolute" else readings


def _squares(measured: _Measured) -> float:
    return float((measured.curve.distance_mm**2 / measured.variance).sum())


def _axis(chain: Chain, measured: _Measured, pooled: float, freedom: int) -> Axis:
    curve, joint = measured.curve, chain.rig.joints[measured.joint]
    scale = max(pooled, _squares(measured) / curve.freedom)
    weighted = curve.sensitivity * (scale * measured.variance)[:, None]
    covariance = np.tensordot(weighted, curve.sensitivity, axes=([1, 2], [1, 2]))
    values = _values(chain, joint.name, measured.sweep)
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
        arc=curve.arc,
        rms_mm=float(np.sqrt((curve.distance_mm**2).mean())),
        freedom=freedom,
        sweep=measured.sweep,
        outliers=measured.outliers,
    )


# -- the start -------------------------------------------------------------------------------------------------------


def _turn_base(chain: Chain, x: Floats, setup: int, axes: Sequence[Axis]) -> None:
    """Turn a base so that the model's directions point as the measured ones do."""
    rotation = chain.base(x, setup).rotation
    modelled = np.array([predicted_curve(chain, x, a).features[DIRECTION] for a in axes]) @ rotation
    measured = np.array([a.direction for a in axes])
    if np.linalg.svd(modelled, compute_uv=False)[1:2].sum() < 0.1:  # parallel axes leave the turn about them open
        return
    # Each direction is a point at distance 1 from an origin that stays where it is.
    points, targets = np.vstack([modelled, -modelled]), np.vstack([measured, -measured])
    turn = rigid_fit(points, targets, np.ones(len(points))).rotation
    x[chain.base_index(setup)] = chain.base_values(setup, Placement(turn, chain.base(x, setup).translation_mm))


def _settle(
    chain: Chain, x: Floats, axes: Sequence[Axis], free: NDArray[np.bool_], precision: Floats, *, directions_only: bool
) -> Floats:
    """Least squares of the axes' features, and the prior, over the free parameters."""
    used = np.zeros(FEATURES, dtype=bool)
    used[DIRECTION] = True
    used[CENTRE] = used[RADIUS] = not directions_only
    floor = np.diag(np.array([_FLOOR_RAD] * 3 + [_FLOOR_MM] * 4 + [1.0]) ** 2)[np.ix_(used, used)]
    whiten = [np.linalg.inv(np.linalg.cholesky(a.covariance[np.ix_(used, used)] + floor)) for a in axes]
    root = np.sqrt(precision[free])
    together = ChainData(
        np.vstack([a.sweep.readings for a in axes]),
        np.concatenate([a.sweep.prism for a in axes]),
        np.concatenate([a.sweep.setup for a in axes]),
    )
    ends = np.cumsum([len(a.sweep) for a in axes]).tolist()
    own = [slice(end - len(a.sweep), end) for end, a in zip(ends, axes, strict=True)]
    values = [_values(chain, a.joint, a.sweep) for a in axes]

    def at(moved: Floats) -> Floats:
        out = x.copy()
        out[free] = moved
        return out

    def curves(places: Floats) -> list[Curve]:
        return [fit_curve(a.kind, places[rows], v) for a, rows, v in zip(axes, own, values, strict=True)]

    def residual(moved: Floats) -> Floats:
        modelled = curves(chain.positions_mm(at(moved), together))
        parts = [w @ (c.features - a.features)[used] for w, c, a in zip(whiten, modelled, axes, strict=True)]
        return np.concatenate([*parts, root * moved])

    def jacobian(moved: Floats) -> Floats:
        lin = chain.linearise(at(moved), together)
        by_parameter = lin.jacobian[:, :, free]
        parts = [
            w @ c.sensitivity[used].reshape(len(w), -1) @ by_parameter[rows].reshape(-1, len(moved))
            for w, c, rows in zip(whiten, curves(lin.position_mm), own, strict=True)
        ]
        return np.vstack([*parts, np.diag(root)])

    rounds = _INNER_ROUNDS if directions_only else _LAST_ROUNDS
    found = least_squares(
        residual,
        x[free],
        jac=jacobian,
        x_scale=1.0 / root,
        ftol=1e-3,
        max_nfev=rounds,
    )
    return at(found.x)


def _place_others(chain: Chain, samples: Samples, x: Floats, seen: Sequence[int]) -> Floats:
    """Place the bases of set-ups that have no sweep, now that the body is known."""
    others = [s for s in range(len(chain.setups)) if s not in seen]
    if not others:
        return x
    names = {chain.setups[s]: Placement.identity() for s in others}
    blank = Chain(chain.rig, names)
    rows = np.isin(samples.data.setup, others)
    data = samples.data.select(rows)
    number = {s: i for i, s in enumerate(others)}
    data = ChainData(data.readings, data.prism, np.array([number[int(s)] for s in data.setup], dtype=np.intp))
    own = Samples(
        data,
        samples.position_mm[rows],
        samples.station_covariance[rows],
        samples.rates[rows],
        np.arange(int(rows.sum())),
        samples.repeat_variance,
    )
    body = np.concatenate([x[: chain.base_start], np.zeros(6 * len(others))])
    # Only a start: whether coordinates are mirrored is judged by the fit.
    start = rough_start(blank, own, body, offsets=False, mirrored="let pass")
    out = x.copy()
    for setup in others:
        out[chain.base_index(setup)] = chain.base_values(setup, start.placements[chain.setups[setup]])
    return out
