"""Observations of a simulated machine at standstill in a sequence of poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from calibration.rig.description import Rig
from simulators.rig.dataset import Floats, SimulatedObservations, Strings, prisms_mm, random_poses, travel_m
from simulators.rig.noise import coordinate_sigma_mm, read_joint, station_covariance_mm2, station_measured_mm
from simulators.rig.truth import RigTruth, replace_effects


def simulate_observations(
    truth: RigTruth,
    n_poses: int,
    seed: int,
    *,
    poses: Mapping[str, Floats] | None = None,
    prisms: Sequence[str] | None = None,
    prisms_per_pose: Literal["all", "one"] = "all",
    repeats: int = 1,
    noise_mm: float | None = None,
    joint_noise: bool = True,
    sigma_columns: bool = False,
    setup: str = "",
    session: str = "",
    columns: Mapping[str, Floats] | None = None,
) -> SimulatedObservations:
    """Measure a machine at standstill in a sequence of poses.

    Args:
        truth: the machine.
        n_poses: number of poses.
        seed: the same seed gives the same poses and noise.
        poses: joint name -> (n_poses,) deg or mm; None for random poses within the limits.
        prisms: names of the prisms to measure; None for all prisms of the rig.
        prisms_per_pose: `all` of them in each pose, or `one` in turn.
        repeats: number of fixes of a prism in a pose.
        noise_mm: standard deviation of each coordinate; None for the rig's station noise (angles, distance, target).
        joint_noise: joint readings have the rig's `sigma` and `resolution`. The error is drawn once per pose, so a
            standing joint reads the same at each of its fixes.
        sigma_columns: add columns sigma_x_mm, sigma_y_mm, sigma_z_mm (without the joints' share).
        setup: name of the station set-up, which also determines where the machine stands.
        session: label of the session.
        columns: name -> (n_poses,) further columns by pose (`payload_kg`, `temperature_degC`); a column given here
            replaces the simulated one.

    Returns:
        Columns `prism`, the joints, x, y, z, `pose`, `time_s`, `dwell_s`, `<joint>_dir`, `<joint>_rate` (0), and
        `setup`, `session` if given. Effects count time from the first row, and temperature from the mean.

    Raises:
        KeyError: a prism is unknown.
        ValueError: an effect of the machine needs a column that is missing.
    """
    rig, rng = truth.rig, np.random.default_rng([seed, 10])
    names = tuple(rig.prism_names if prisms is None else prisms)
    held = random_poses(rig, n_poses, rng) if poses is None else {k: np.asarray(v, float) for k, v in poses.items()}
    before = random_poses(rig, 1, rng)
    by_pose = _approach(rig, held, before, rng) | {f"{j.name}_rate": np.zeros(n_poses) for j in rig.joints}
    by_pose |= dict(columns or {})
    read = {j.name: read_joint(j, held[j.name], rng) if joint_noise else held[j.name] for j in rig.joints}

    turns = len(names) if prisms_per_pose == "all" else 1
    pose = np.repeat(np.arange(n_poses), turns * repeats)
    if prisms_per_pose == "all":
        which = np.tile(np.repeat(np.arange(len(names)), repeats), n_poses)
    else:
        which = np.repeat(np.arange(n_poses) % len(names), repeats)
    shot = np.tile(np.arange(turns * repeats), n_poses)

    prism_column: Strings = np.array(names, dtype=np.str_)[which]
    # One fix per second in a pose; the dwell is the time from the end of the motion to the fix
    by_row = {k: v[pose] + (shot if k in ("time_s", "dwell_s") else 0.0) for k, v in by_pose.items()}
    seen = by_row | {k: v[pose] for k, v in travel_m(rig, held).items()}
    anchored = anchored_truth(truth, seen)
    true_mm, oracle_mm = (
        prisms_mm(anchored, prism_column, {k: v[pose] for k, v in joints.items()}, seen, setup=setup)
        for joints in (held, read)
    )
    if noise_mm is None:
        measured_mm = station_measured_mm(rig.station, true_mm, rng)
        sigma_mm = coordinate_sigma_mm(station_covariance_mm2(rig.station, true_mm))
    else:
        measured_mm = true_mm + rng.normal(0, noise_mm, true_mm.shape)
        sigma_mm = np.full_like(true_mm, noise_mm)

    table: dict[str, Floats | Strings] = {"prism": prism_column}
    table |= {j.column: read[j.name][pose] for j in rig.joints}
    table |= {f"{axis}_mm": measured_mm[:, i] for i, axis in enumerate("xyz")}
    for label, value in (("setup", setup), ("session", session)):
        if value:
            table[label] = np.full(len(pose), value)
    table["pose"] = pose.astype(np.str_)
    if sigma_columns:
        table |= {f"sigma_{axis}_mm": sigma_mm[:, i] for i, axis in enumerate("xyz")}
    return SimulatedObservations(table | by_row, measured_mm, oracle_mm)


def anchored_truth(truth: RigTruth, columns: Mapping[str, Floats]) -> RigTruth:
    """Return the machine with effects that count time from the first of the rows, and temperature from their mean.

    Args:
        truth: the machine.
        columns: observation columns, name -> (n,); `time_s` and `temperature_degC` are used.
    """
    if not truth.effects:
        return truth
    first_s = float(np.min(columns.get("time_s", np.zeros(1))))
    mean_degC = float(np.mean(columns.get("temperature_degC", np.zeros(1))))
    return replace_effects(truth, [effect.anchored(first_s, mean_degC) for effect in truth.effects])


def _approach(
    rig: Rig, held: Mapping[str, Floats], before: Mapping[str, Floats], rng: np.random.Generator
) -> dict[str, Floats]:
    """Return columns by pose: time and dwell of the first fix, and direction from which each joint arrived."""
    steps = {name: np.diff(values, prepend=before[name]) for name, values in held.items()}
    travel_s = np.max([np.abs(steps[j.name]) / (0.25 * j.max_rate) for j in rig.joints], axis=0)
    dwell_s = rng.uniform(5.0, 60.0, len(travel_s))
    out = {"time_s": np.cumsum(travel_s + dwell_s), "dwell_s": dwell_s}
    return out | {f"{name}_dir": np.sign(step) for name, step in steps.items()}
