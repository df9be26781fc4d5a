"""A shift of work, pose by pose: where the joints are, how they came there, and what the signals are meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig
from simulators.hydraulics import CURRENT_DITHER_MA, PRESSURE_NOISE_BAR, motion_columns
from simulators.pose_plans import PosePlan, draw_poses
from simulators.truth import RigTruth

Floats = NDArray[np.float64]

_OVERSHOOT_SHARE = 0.3  # of the motions: past the pose and back
_CREEP_RATE = 0.045  # of a joint's maximum rate, at most: 0.9 deg/s at 20
_STILL_SHARE = 0.3  # of the joints, while others creep
_SHORTEST_GAP = 0.4  # between poses, of the mean one; breaks make the long ones
_DWELL_SHARES = 0.1, 0.9  # of the time since the pose before
_RATE_OVER_S = 0.5  # readings that far apart give a rate
_ROD_KG = 300.0
_ROD_CHANGES = 2, 6  # in a shift
_DAY_K, _AIR_DEGC, _GUST_K = 8.0, 15.0, 0.6
_FOLLOWING_K = 10.0  # a decoy's temperature over the shift
_THERMOMETER_K = 0.2
_VISIT_DWELL_S = 20.0
_DECOY = "spare"
_IDLE_BAR, _SUPPLY_BAR = 40.0, 120.0
_BAR_PER_NEWTON = 1e-5 / 7.9e-3  # a piston of 100 mm


@dataclass(frozen=True)
class Shift:
    """n poses in the order of their times.

    Attributes:
        joints: joint name -> (n,) deg or mm.
        columns: what effects may depend on, without any sensor's error -> (n,).
    """

    joints: Mapping[str, Floats]
    columns: Mapping[str, Floats]

    def recorded(self, rig: Rig, rng: np.random.Generator) -> dict[str, Floats]:
        """(n,) columns as their sensors give them, but for the readings of the joints."""
        out: dict[str, Floats] = {}
        for name, values in self.columns.items():
            n = len(values)
            if name.endswith("_rate"):
                sigma = np.sqrt(2.0) * rig.joint(name.removesuffix("_rate")).sigma / _RATE_OVER_S
                out[name] = np.where(values == 0.0, 0.0, values + rng.normal(0.0, sigma, n))
            elif name.endswith("_mA"):
                out[name] = np.rint(values + (values != 0.0) * rng.normal(0.0, CURRENT_DITHER_MA, n))
            elif name.endswith("_bar"):
                out[name] = np.rint(10.0 * (values + rng.normal(0.0, PRESSURE_NOISE_BAR, n))) / 10.0
            elif name == "temperature_degC":
                out[name] = np.rint(10.0 * (values + rng.normal(0.0, _THERMOMETER_K, n))) / 10.0
            else:
                out[name] = values
        return out


def draw_shift(
    truth: RigTruth,
    n: int,
    plan: PosePlan,
    rng: np.random.Generator,
    *,
    hours: float,
    moving: float,
    decoy_temperature: bool,
    decoys: int,
) -> Shift:
    """Work through n poses.

    Args:
        truth: the machine; its loads make the pressures.
        n: how many.
        plan: see `draw_poses`.
        rng: source.
        hours: length.
        moving: share of the poses that joints creep through.
        decoy_temperature: the temperature follows the time.
        decoys: how many signals nothing depends on.
    """
    rig = truth.rig
    joints = draw_poses(rig, plan, n, rng)
    gap = _SHORTEST_GAP + rng.exponential(1.0 - _SHORTEST_GAP, n)
    gap_s = 3600.0 * hours * gap / gap.sum()
    time_s = np.cumsum(gap_s)
    creeps = rng.random(n) < moving
    columns: dict[str, Floats] = {
        "time_s": np.rint(time_s * 10.0) / 10.0,
        "dwell_s": np.where(creeps, 0.0, np.rint(gap_s * rng.uniform(*_DWELL_SHARES, n) * 10.0) / 10.0),
    }
    for joint in rig.joints:
        taking_part = creeps & (rng.random(n) >= _STILL_SHARE)
        most = _CREEP_RATE * joint.max_rate
        rate = np.where(taking_part, rng.uniform(-most, most, n), 0.0)
        came = np.sign(np.diff(joints[joint.name], prepend=joints[joint.name][1 % n]))
        came = came * np.where(rng.random(n) < _OVERSHOOT_SHARE, -1.0, 1.0)
        columns[f"{joint.name}_rate"] = rate
        columns[f"{joint.name}_dir"] = np.where(rate != 0.0, np.sign(rate), came).astype(float)
    columns["temperature_degC"] = _temperature(time_s / time_s[-1], decoy_temperature, rng)
    if any(mass.payload for mass in rig.masses):
        changes = np.isin(np.arange(n), rng.integers(n // 8, max(n - n // 8, n // 8 + 1), rng.integers(*_ROD_CHANGES)))
        columns["payload_kg"] = _ROD_KG * ((np.cumsum(changes) + rng.integers(2)) % 2).astype(float)
    columns |= _machine_signals(truth, joints, columns, rng)
    return Shift(joints, columns | _decoys(decoys, n, rng))


def visit(
    truth: RigTruth,
    poses: Mapping[str, Floats],
    here: Mapping[str, float],
    last: Mapping[str, float],
    given: Mapping[str, Floats],
    rng: np.random.Generator,
) -> Shift:
    """Go on to n further poses after a shift.

    Args:
        truth: the machine.
        poses: joint name -> (n,) deg or mm.
        here: joint name -> where the shift ended.
        last: columns as they were then.
        given: columns that are asked for -> (n,); the others are those of standstills a minute apart, reached straight
            from pose to pose, with all else as at the shift's end.
        rng: source.
    """
    rig, n = truth.rig, len(next(iter(poses.values())))
    columns: dict[str, Floats] = {
        "time_s": last["time_s"] + 60.0 * np.arange(1.0, n + 1.0),
        "dwell_s": np.full(n, _VISIT_DWELL_S, dtype=float),
        "temperature_degC": np.full(n, last["temperature_degC"], dtype=float),
    }
    for joint in rig.joints:
        columns[f"{joint.name}_rate"] = np.zeros(n)
        columns[f"{joint.name}_dir"] = np.sign(np.diff(poses[joint.name], prepend=here[joint.name])).astype(float)
    if "payload_kg" in last:
        columns["payload_kg"] = np.full(n, last["payload_kg"])
    columns |= {name: np.asarray(values, float) for name, values in given.items() if name in last}
    columns = _machine_signals(truth, poses, columns, rng) | columns
    columns |= _decoys(sum(name.startswith(_DECOY) for name in last), n, rng)
    return Shift(dict(poses), {name: columns[name] for name in last if name in columns})


def _machine_signals(
    truth: RigTruth, joints: Mapping[str, Floats], columns: Mapping[str, Floats], rng: np.random.Generator
) -> dict[str, Floats]:
    """Pressures in the cylinders and the machine's own signals, at these joints and rates."""
    rig, out = truth.rig, dict[str, Floats]()
    for joint in rig.joints:
        if joint.kind == "prismatic":
            load = np.abs(truth.gravity_load(joint.name, joints, columns))
            supply = _IDLE_BAR + rng.uniform(0.0, _SUPPLY_BAR, len(load))
            out[f"{joint.name}_bar"] = supply + _BAR_PER_NEWTON * load
    return out | motion_columns({j.name: columns[f"{j.name}_rate"] / j.max_rate for j in rig.joints})


def _decoys(number: int, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Signals that nothing depends on: noise and random walks."""
    columns: dict[str, Floats] = {}
    for index in range(number):
        steps = rng.normal(0.0, 20.0, n)
        if index % 2:
            columns[f"{_DECOY}{index + 1}_mA"] = 300.0 + np.cumsum(steps) / 10.0
        else:
            columns[f"{_DECOY}{index + 1}_bar"] = 100.0 + steps
    return columns


def _temperature(part: Floats, follows_time: bool, rng: np.random.Generator) -> Floats:
    """(n,) of the steel, at parts of the shift from 0 to 1."""
    if follows_time:
        return _AIR_DEGC + _FOLLOWING_K * part + rng.normal(0.0, _THERMOMETER_K, len(part))
    day = _DAY_K * np.sin(2.4 * part + rng.uniform(-0.3, 0.9))
    course: Floats = _AIR_DEGC + day + rng.normal(0.0, _GUST_K, len(part))
    return course
