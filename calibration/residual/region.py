"""The region in which a residual learner was trained: outside it the estimate fades to zero, with a warning.

A row is outside the region for one of three reasons: a joint reads beyond the range of the training data; the pose is
farther from all training poses than those on which cross-validation has shown that the learner helps; or a signal
is outside its range in training, as at a different site, under a different load, or after a sensor has shifted. In all
three cases the estimate fades to zero. A missing signal is replaced by its usual value, and the weight of the estimate
is reduced by the share of the gain that depends on that signal. All weights are continuous, so that the estimate does
not jump as a rig moves out of the region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.numerics.jit import compiled, part
from calibration.numerics.stored_arrays import LARGEST, float_array, read_npz, write_npz
from calibration.observations import Floats
from calibration.residual.features import Features
from calibration.rig.description import Joint

_FILE = "region.npz"

# Rows of the table of joints, deg or mm.
_CENTRE, _HALF, _MARGIN, _SCALE, _TURN = range(5)
# Rows of the table of signals, in the signal's unit; LOSS is a share and GAPS 0 or 1.
_LOW, _HIGH, _ROOM, _USUAL, _LOSS, _GAPS = range(6)

_MARGIN_SHARE = 0.1  # of a range; by that much readings may leave it before the estimate fades
_LEAST_MARGIN = {"revolute": 1.0, "prismatic": 10.0}  # deg, mm
_POSES = 256
_MOST_ROWS = 5000  # from which representatives are chosen
_QUANTILE = 0.99  # of the held-out rows' distances from trained poses, which defines "near"
_NEAR_FACTOR = 1.25  # on that distance
_LEAST_NEAR = 0.02  # in ranges of the joints
_OFTEN_MISSING = 0.05  # share of training rows without a signal, above which its absence is normal
_PROBED = 500  # rows on which the importance of signals is measured
_FADE = 2.0  # margins beyond the margin, over which the weight falls to zero
_NOTABLE = 0.01  # of a residual's gain; signals that matter less are not reported
_FADED = 0.9  # weights above this are not reported


@dataclass(frozen=True)
class Region:
    """The region of a learner.

    Attributes:
        joints: (5, j) centre and half width of each joint's range in training, margin, scale of distances (deg or mm),
            and 360 for angles whose whole turns change nothing, else 0.
        poses: (m, j) representative readings.
        near: distance to the nearest representative pose, in scales of the joints, up to which the weight is 1.
        signals: names of the s signal columns.
        table: (6, s) lowest, highest, margin and usual value of each signal, share of the gain that is lost without it,
            and whether training rows lacked it as well, 0 or 1.
    """

    joints: Floats
    poses: Floats
    near: float
    signals: tuple[str, ...]
    table: Floats

    def confine(self, features: Features) -> tuple[Features, Floats]:
        """Bring features into the region and compute the weight of the estimate in each row.

        Args:
            features: n rows with the columns with which the region was fitted.

        Returns:
            Features with whole turns removed from angles and with signals out of range at their usual values; and the
            (n,) weights, 0 to 1.
        """
        geometry, signals = features.geometry.copy(), features.signals.copy()
        weight = _confine(self.joints, self.poses, self.near, self.table, geometry, signals)
        return replace(features, geometry=geometry, signals=signals), weight

    def warnings(self, features: Features, joints: Sequence[Joint]) -> Iterator[str]:
        """Yield warnings about rows outside the region, and about signals out of their range in training."""
        if len(features) == 0:
            return
        for name, values, (low, high, room, _, _, _) in self._notable(features):
            outside = int(((values < low - room) | (values > high + room)).sum())
            if outside:
                yield (
                    f"{name}: {outside} of {len(values)} readings are outside the {low:.4g} .. {high:.4g} of the "
                    f"training data (another site, a shifted sensor, or another unit?); there the residual fades"
                )
        _, weight = self.confine(features)
        faded = int((weight < _FADED).sum())
        if faded:
            yield (
                f"the residual fades: {faded} of {len(weight)} rows lie outside the region of its training data "
                f"({', '.join(self._reasons(features, joints))}); {int((weight == 0.0).sum())} rows "
                f"({(weight == 0.0).mean():.0%}) are not corrected at all"
            )

    def _notable(self, features: Features) -> Iterator[tuple[str, Floats, Floats]]:
        """Yield name, values and column of the table of each signal that matters."""
        for k in np.flatnonzero(self.table[_LOSS] >= _NOTABLE):
            yield self.signals[k], features.signals[:, k], self.table[:, k]

    def _reasons(self, features: Features, joints: Sequence[Joint]) -> Iterator[str]:
        centre, half, margin, _, turn = self.joints
        away = features.geometry[:, : len(joints)] - centre
        near = away - turn * np.floor(away / np.where(turn > 0.0, turn, np.inf) + 0.5)
        away = np.where(np.abs(away) > half, near, away)
        inside = (np.abs(away) <= half + margin).all(axis=1)
        for k, joint in enumerate(joints):
            for side, beyond, limit in (("below", -away, centre - half), ("above", away, centre + half)):
                strange = int((beyond[:, k] > half[k] + margin[k]).sum())
                if strange:
                    yield f"{joint.name} {side} {limit[k]:.1f} {joint.unit} in {strange}"
        by_joints = replace(self, signals=(), table=self.table[:, :0])
        _, weight = by_joints.confine(replace(features, signals=features.signals[:, :0]))
        far = int(((weight < _FADED) & inside).sum())
        if far:
            yield f"far from every trained pose in {far}"
        for name, values, (low, high, room, _, _, gaps) in self._notable(features):
            missing, outside = ~np.isfinite(values) & (gaps == 0.0), (values < low - room) | (values > high + room)
            for what, rows in (("missing", missing), ("out of range", outside)):
                if rows.any():
                    yield f"{name} {what} in {int(rows.sum())}"

    def fits(self, joints: int) -> bool:
        """Return True if the tables have the shapes and values on which `confine` relies."""
        return (
            self.joints.shape == (5, joints)
            and self.poses.ndim == 2
            and 0 < len(self.poses) <= _POSES
            and self.poses.shape[1] == joints
            and self.table.shape == (6, len(self.signals))
            and all(bool((np.abs(part) <= LARGEST).all()) for part in (self.joints, self.poses))
            and bool((np.abs(self.table) <= LARGEST**2).all())
            and 0.0 < self.near <= LARGEST
            and bool((self.joints[[_MARGIN, _SCALE]] > 0.0).all() and (self.table[_ROOM] > 0.0).all())
            and bool((self.joints[[_HALF, _TURN]] >= 0.0).all())
            and bool((self.table[_LOW] <= self.table[_HIGH]).all())
            and bool(((self.table[_LOSS] >= 0.0) & (self.table[_LOSS] <= 1.0)).all())
        )

    def to_files(self) -> dict[str, bytes]:
        """Return one npz file without pickled objects."""
        parts = {"joints": self.joints, "poses": self.poses, "near": np.array([self.near]), "table": self.table}
        return {_FILE: write_npz({**parts, "signals": np.array(self.signals, dtype=np.str_)})}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> Region:
        """Restore from `to_files`; KeyError or ValueError if parts are missing. `fits` checks whether they match."""
        stored = read_npz(files[_FILE])
        joints, poses, near, table = (float_array(stored, k) for k in ("joints", "poses", "near", "table"))
        signals = np.asarray(stored["signals"])
        if near.shape != (1,) or signals.ndim != 1 or signals.dtype.kind != "U":
            raise ValueError(f"{_FILE} lacks a list of signals or a single distance")
        return cls(joints, poses, float(near[0]), tuple(signals.tolist()), table)


def fit_region(
    features: Features,
    joints: Sequence[Joint],
    turns: Floats,
    signals: Sequence[str],
    split: NDArray[np.intp],
    predict: Callable[[Features], Floats],
    gain_mm2: float,
) -> Region:
    """Determine the region of a learner.

    Args:
        features: n training rows of the learner.
        joints: joints of the rig, whose readings are the first columns.
        turns: (j,) 360 for joints whose whole turns change nothing, else 0.
        signals: names of the signal columns.
        split: (n,) fold that held each row out in cross-validation of the learner.
        predict: function from features to the learner's estimates (n, 3), mm.
        gain_mm2: reduction of the mean squared error of held-out rows by the learner.
    """
    readings = features.geometry[:, : len(joints)]
    low, high = readings.min(axis=0), readings.max(axis=0)
    least = np.array([_LEAST_MARGIN[joint.kind] for joint in joints])
    margin = np.maximum(_MARGIN_SHARE * (high - low), least)
    table = np.array([(low + high) / 2.0, (high - low) / 2.0, margin, margin / _MARGIN_SHARE, turns])
    scaled = readings / table[_SCALE]
    return Region(
        table,
        np.ascontiguousarray(readings[_representatives(scaled)]),
        _NEAR_FACTOR * max(_usual_distance(scaled, split), _LEAST_NEAR),
        tuple(signals),
        _signal_table(features, predict, gain_mm2),
    )


def _representatives(scaled: Floats) -> NDArray[np.intp]:
    """Choose up to 256 rows far apart from each other: each is the farthest from those before (Gonzalez 1985)."""
    offered = np.unique(np.linspace(0, len(scaled) - 1, min(len(scaled), _MOST_ROWS)).astype(np.intp))
    points = scaled[offered]
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    square = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < _POSES and square.max() > 0.0:
        chosen.append(int(square.argmax()))
        square = np.minimum(square, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return offered[chosen]


def _usual_distance(scaled: Floats, split: NDArray[np.intp]) -> float:
    """Return the 99 % quantile of the distance of held-out rows from the representatives of the other rows."""
    found = []
    for fold in np.unique(split):
        training, held = scaled[split != fold], scaled[split == fold]
        poses = training[_representatives(training)]
        square = (held**2).sum(axis=1)[:, None] + (poses**2).sum(axis=1) - 2.0 * held @ poses.T
        found.append(np.sqrt(np.maximum(square.min(axis=1), 0.0)))
    return float(np.quantile(np.concatenate(found), _QUANTILE))


def _signal_table(features: Features, predict: Callable[[Features], Floats], gain_mm2: float) -> Floats:
    """Return `Region.table` (6, s)."""
    signals = features.signals
    count = signals.shape[1]
    if count == 0:
        return np.empty((6, 0))
    low, high, usual = np.nanmin(signals, axis=0), np.nanmax(signals, axis=0), np.nanmedian(signals, axis=0)
    room = np.maximum(_MARGIN_SHARE * (high - low), 1e-9 * np.maximum(np.abs(low), np.abs(high)))
    room = np.maximum(room, 1e-12)
    gaps = np.isnan(signals).mean(axis=0) > _OFTEN_MISSING
    rows = np.unique(np.linspace(0, len(features) - 1, min(len(features), _PROBED)).astype(np.intp))
    probe = features.select(rows)
    with_all = predict(probe)

    def cost_mm2(columns: NDArray[np.intp]) -> float:
        replaced = probe.signals.copy()
        replaced[:, columns] = usual[columns]
        return float(((predict(replace(probe, signals=replaced)) - with_all) ** 2).sum(axis=1).mean())

    cost = np.array([cost_mm2(np.array([k])) for k in range(count)])
    # Signals that can replace each other cost little one by one, but much together.
    together = cost_mm2(np.arange(count)) / max(float(cost.sum()), 1e-12)
    share = cost * max(1.0, together) / max(gain_mm2, 1e-12)
    return np.array([low, high, room, usual, np.minimum(share, 1.0), gaps.astype(float)])


# -- compiled: a call for one pose costs microseconds ------------------------------------------------------------------


@part()
def _falling(excess: float) -> float:
    """Return a weight that falls smoothly from 1, where the excess is 0 or less, to 0, where it is 1 or more."""
    if excess <= 0.0:
        return 1.0
    if excess >= 1.0:
        return 0.0
    return 1.0 - excess * excess * (3.0 - 2.0 * excess)


@part()
def _short_way(change: float, turn: float) -> float:
    """Return a change of an angle without whole turns; other values, whose turn is 0, are returned unchanged."""
    if turn > 0.0 and 2.0 * abs(change) > turn:
        return change - turn * math.floor(change / turn + 0.5)
    return change


@part()
def _joint_weight(joints: Floats, row: int, readings: Floats) -> float:
    """Return the weight by the ranges of the joints; readings beyond them are moved to the turn nearest the centre."""
    weight = 1.0
    for k in range(joints.shape[1]):
        away = readings[row, k] - joints[_CENTRE, k]
        if abs(away) > joints[_HALF, k]:
            near = _short_way(away, joints[_TURN, k])
            if near != away:
                readings[row, k] = joints[_CENTRE, k] + near
                away = near
        weight *= _falling((abs(away) - joints[_HALF, k] - joints[_MARGIN, k]) / (_FADE * joints[_MARGIN, k]))
    return weight


@part()
def _nearness(joints: Floats, poses: Floats, near: float, row: int, readings: Floats) -> float:
    """Return the weight by the distance to the nearest pose: 1 up to `near`, falling to 0 at twice that."""
    least = 4.0 * near * near
    for m in range(len(poses)):
        square = 0.0
        for k in range(joints.shape[1]):
            away = _short_way(readings[row, k] - poses[m, k], joints[_TURN, k]) / joints[_SCALE, k]
            square += away * away
            if square >= least:
                break
        if square < least:
            least = square
            if least <= near * near:
                return 1.0
    return _falling(math.sqrt(least) / near - 1.0)


@part()
def _signal_weight(table: Floats, row: int, signals: Floats) -> float:
    """Return the weight by the signals, and move missing or out-of-range signals towards their usual values.

    A missing signal costs its share of the gain. A signal that matters and is far out of range sets the weight to zero:
    its cause, such as a different site or load, may invalidate the rest of the estimate as well.
    """
    lost, trusted = 0.0, 1.0
    for k in range(table.shape[1]):
        value = signals[row, k]
        if math.isfinite(value):
            away = max(table[_LOW, k] - value, value - table[_HIGH, k])
            trust = _falling((away - table[_ROOM, k]) / (_FADE * table[_ROOM, k]))
            if trust < 1.0:
                signals[row, k] = table[_USUAL, k] + trust * (value - table[_USUAL, k])
                if table[_LOSS, k] >= _NOTABLE:
                    trusted *= trust
        elif table[_GAPS, k] == 0.0:
            signals[row, k] = table[_USUAL, k]
            lost += table[_LOSS, k]
    return trusted * max(0.0, 1.0 - lost)


@compiled
def _confine(joints: Floats, poses: Floats, near: float, table: Floats, readings: Floats, signals: Floats) -> Floats:
    """Return the (n,) weights of a residual, 0 to 1, and bring readings and signals into its region in place.

    `joints`, `poses`, `near` and `table` are fields of a `Region`. Joints are in the first columns of `readings`.
    """
    weight = np.empty(len(readings))
    for row in range(len(readings)):
        weight[row] = _joint_weight(joints, row, readings)
        if weight[row] > 0.0:
            weight[row] *= _nearness(joints, poses, near, row, readings)
        weight[row] *= _signal_weight(table, row, signals)
    return weight
