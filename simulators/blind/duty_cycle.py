"""Duty cycle of the boom, pose by pose: joint values, directions and rates, with signals and temperatures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Rig
from simulators.hydraulics import CURRENT_DITHER_MA, PRESSURE_NOISE_BAR, motion_columns
from simulators.rig.dataset import random_poses
from simulators.rig.screws import Posture, ScrewChain, nominal_constants, pose_chain, screw_chain
from simulators.rig.truth import RigTruth

Floats = NDArray[np.float64]
PosePlan = Literal["wide", "face", "sparse", "path"]

_FACE_SHARE = 0.45  # share of a revolute joint's range, about its middle, used before the feed is set parallel
_FACE_ROUNDS = 3
_FACE_JITTER_DEG = 0.5  # an operator sets the feed parallel by eye and with the angle display
_POSES_A_CLUSTER = 6
_POSES_A_WAY_POINT = 12
_CLUSTER_SHARE = 0.04  # standard deviation in a cluster, as a share of a joint's range

_HOURS = 8.0  # length of a duty cycle
_OVERSHOOT_SHARE = 0.3  # share of the motions that go past the pose and back
_CREEP_RATE = 0.045  # largest creep rate as a share of a joint's maximum rate: 0.9 deg/s at 20
_STILL_SHARE = 0.3  # share of the joints that stand still while others creep
_SHORTEST_GAP = 0.4  # shortest time between poses as a share of the mean; breaks are the long gaps
_DWELL_SHARES = 0.1, 0.9  # limits of the dwell as shares of the time since the previous pose
_RATE_OVER_S = 0.5  # a rate is computed from readings this far apart
_ROD_KG = 300.0
_ROD_CHANGES = 2, 6  # number in a duty cycle
_DAY_K, _AIR_DEGC, _GUST_K = 8.0, 15.0, 0.6
_FOLLOWING_K = 10.0  # rise of a decoy's temperature over the duty cycle
_THERMOMETER_K = 0.2
_VISIT_DWELL_S = 20.0
_DECOY = "spare"
_DECOYS = 4
_IDLE_BAR, _SUPPLY_BAR = 40.0, 120.0
_BAR_PER_NEWTON = 1e-5 / 7.9e-3  # a piston of 100 mm


@dataclass(frozen=True)
class DutyCycle:
    """n poses in order of time.

    Attributes:
        joints: joint name -> (n,) deg or mm.
        columns: name -> (n,) true value of a quantity on which effects may depend, without sensor errors.
    """

    joints: Mapping[str, Floats]
    columns: Mapping[str, Floats]

    def recorded(self, rig: Rig, rng: np.random.Generator) -> dict[str, Floats]:
        """Return the columns with sensor errors, name -> (n,), except the readings of the joints."""
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


def draw_duty_cycle(
    truth: RigTruth,
    n: int,
    plan: PosePlan,
    rng: np.random.Generator,
    *,
    moving: float,
    is_decoy: bool,
) -> DutyCycle:
    """Draw a duty cycle of n poses.

    Args:
        truth: the machine; its loads determine the pressures.
        n: number of poses.
        plan: see `draw_poses`.
        rng: random generator.
        moving: share of the poses through which joints creep.
        is_decoy: the temperature follows the time, and there are signals on which nothing depends.
    """
    rig = truth.rig
    joints = draw_poses(rig, plan, n, rng)
    gap = _SHORTEST_GAP + rng.exponential(1.0 - _SHORTEST_GAP, n)
    gap_s = 3600.0 * _HOURS * gap / gap.sum()
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
    columns["temperature_degC"] = _temperature(time_s / time_s[-1], is_decoy, rng)
    if any(mass.payload for mass in rig.masses):
        changes = np.isin(np.arange(n), rng.integers(n // 8, max(n - n // 8, n // 8 + 1), rng.integers(*_ROD_CHANGES)))
        columns["payload_kg"] = _ROD_KG * ((np.cumsum(changes) + rng.integers(2)) % 2).astype(float)
    columns |= _machine_signals(truth, joints, columns, rng)
    return DutyCycle(joints, columns | _decoys(_DECOYS if is_decoy else 0, n, rng))


def continue_duty_cycle(
    truth: RigTruth,
    poses: Mapping[str, Floats],
    here: Mapping[str, float],
    last: Mapping[str, float],
    given: Mapping[str, Floats],
    rng: np.random.Generator,
) -> DutyCycle:
    """Continue a duty cycle with n further poses.

    Args:
        truth: the machine.
        poses: joint name -> (n,) deg or mm.
        here: joint name -> value at the end of the duty cycle.
        last: column name -> value at the end of the duty cycle.
        given: column name -> (n,) requested values. Other columns describe standstills a minute apart, reached straight
            from pose to pose, under the conditions at the end of the duty cycle.
        rng: random generator.
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
    return DutyCycle(dict(poses), {name: columns[name] for name in last if name in columns})


def _machine_signals(
    truth: RigTruth, joints: Mapping[str, Floats], columns: Mapping[str, Floats], rng: np.random.Generator
) -> dict[str, Floats]:
    """Return the pressures in the cylinders and the machine's own signals, at the given joints and rates."""
    rig, out = truth.rig, dict[str, Floats]()
    for joint in rig.joints:
        if joint.kind == "prismatic":
            load = np.abs(truth.gravity_load(joint.name, joints, columns))
            supply = _IDLE_BAR + rng.uniform(0.0, _SUPPLY_BAR, len(load))
            out[f"{joint.name}_bar"] = supply + _BAR_PER_NEWTON * load
    return out | motion_columns({j.name: columns[f"{j.name}_rate"] / j.max_rate for j in rig.joints})


def _decoys(number: int, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return signals on which nothing depends: noise and random walks."""
    columns: dict[str, Floats] = {}
    for index in range(number):
        steps = rng.normal(0.0, 20.0, n)
        if index % 2:
            columns[f"{_DECOY}{index + 1}_mA"] = 300.0 + np.cumsum(steps) / 10.0
        else:
            columns[f"{_DECOY}{index + 1}_bar"] = 100.0 + steps
    return columns


def _temperature(part: Floats, follows_time: bool, rng: np.random.Generator) -> Floats:
    """Return the (n,) temperature of the steel in degC; `part` is the elapsed share of the duty cycle, 0 to 1."""
    if follows_time:
        return _AIR_DEGC + _FOLLOWING_K * part + rng.normal(0.0, _THERMOMETER_K, len(part))
    day = _DAY_K * np.sin(2.4 * part + rng.uniform(-0.3, 0.9))
    course: Floats = _AIR_DEGC + day + rng.normal(0.0, _GUST_K, len(part))
    return course


def draw_poses(rig: Rig, plan: PosePlan, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw poses within the joint limits.

    Args:
        rig: description with joints and limits.
        plan: `wide`: uniformly between the limits; `face`: the last frame's z axis (the feed) held parallel to one
            direction, as a drill plan requires, so that joints move little and compensate each other; `sparse`: a few
            clusters of nearly equal poses; `path`: one after another along a smooth path.
        n: number of poses.
        rng: random generator.

    Returns:
        Joint name -> (n,) deg or mm.
    """
    if plan == "wide":
        return random_poses(rig, n, rng)
    if plan == "face":
        return _face(rig, n, rng)
    if plan == "path":
        return _path(rig, n, rng)
    centres = random_poses(rig, max(4, -(-n // _POSES_A_CLUSTER)), rng)
    which = rng.integers(len(next(iter(centres.values()))), size=n)
    spread = {j.name: _CLUSTER_SHARE * (j.limits[1] - j.limits[0]) for j in rig.joints}
    return _within(rig, {k: v[which] + rng.normal(0.0, spread[k], n) for k, v in centres.items()})


def _path(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return poses at equal steps along a path through random way points; no joint overshoots the way points."""
    way_points = max(3, 1 + -(-n // _POSES_A_WAY_POINT))
    at, steps = np.arange(float(way_points)), np.linspace(0.0, way_points - 1.0, n)
    from scipy.interpolate import PchipInterpolator

    return {k: PchipInterpolator(at, v)(steps) for k, v in random_poses(rig, way_points, rng).items()}


def _face(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    chain = screw_chain(rig, nominal_constants(rig))
    turning = [j for j in rig.joints if j.kind == "revolute"]
    span = np.deg2rad([j.limits[1] - j.limits[0] for j in turning])
    middle = {j.name: np.array([sum(j.limits) / 2]) for j in rig.joints}
    feed = pose_chain(chain, _radians(rig, middle)).axes(len(rig.rows))[0, :, 2]
    poses = random_poses(rig, n, rng)
    for joint in turning:
        poses[joint.name] = middle[joint.name] + _FACE_SHARE * (poses[joint.name] - middle[joint.name])
    for _ in range(_FACE_ROUNDS):
        posture = pose_chain(chain, _radians(rig, poses))
        axis = posture.axes(len(rig.rows))[:, :, 2]
        turns = _turn_axes(chain, posture, [j.name for j in turning], len(rig.rows))
        across = turns - axis[:, :, None] * (axis[:, None, :] @ turns)
        missing = np.cross(axis, feed)
        # Each joint contributes according to its range: least squares in units of the ranges
        weighted = across * span**2
        normal = weighted @ across.transpose(0, 2, 1) + 1e-6 * np.eye(3)
        step = (weighted.transpose(0, 2, 1) @ np.linalg.solve(normal, missing[:, :, None]))[:, :, 0]
        for i, joint in enumerate(turning):
            poses[joint.name] = poses[joint.name] + np.rad2deg(step[:, i])
        poses = _within(rig, poses)
    for joint in turning:
        poses[joint.name] = poses[joint.name] + rng.normal(0.0, _FACE_JITTER_DEG, n)
    return _within(rig, poses)


def _turn_axes(chain: ScrewChain, posture: Posture, joints: list[str], frame: int) -> Floats:
    """Return the (n, 3, joints) rotation vector of a frame per radian of each joint."""
    out = np.zeros((len(posture.rotations[0]), 3, len(joints)))
    for index, screw in enumerate(chain.screws):
        if screw.turns and chain.carries(index, frame):
            axis, _ = posture.axis(index)
            for i, joint in enumerate(joints):
                if joint in screw.weights:
                    out[:, :, i] += screw.weights[joint] * axis
    return out


def _radians(rig: Rig, poses: dict[str, Floats]) -> dict[str, Floats]:
    return {j.name: np.deg2rad(poses[j.name]) if j.kind == "revolute" else poses[j.name] for j in rig.joints}


def _within(rig: Rig, poses: dict[str, Floats]) -> dict[str, Floats]:
    return {j.name: np.clip(poses[j.name], *j.limits) for j in rig.joints}
