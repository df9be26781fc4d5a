"""Observations of a simulated machine, straight into the observations table: no protocols, no waiting."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Joint, Rig, Station
from simulators.truth import RigTruth, replace_effects

Floats = NDArray[np.float64]
Strings = NDArray[np.str_]

ARCSEC = np.pi / 180 / 3600


@dataclass(frozen=True)
class SimulatedObservations:
    """n fixes with their joint readings, and what the truth knows about them.

    Attributes:
        columns: the observations CSV's columns, in order: name -> (n,) strings or numbers.
        measured_mm: (n, 3) the fixes, as in x_mm, y_mm, z_mm.
        oracle_mm: (n, 3) where the true machine has the prism *if the joints are as read*: what a perfect model
            would predict from the same row.
    """

    columns: Mapping[str, Floats | Strings]
    measured_mm: Floats
    oracle_mm: Floats

    def __len__(self) -> int:
        return len(self.measured_mm)

    @property
    def noise_rms_mm(self) -> float:
        """RMS of the 3-D difference of measurement and oracle: no model can do better but by luck."""
        return float(np.sqrt(np.mean(np.sum((self.measured_mm - self.oracle_mm) ** 2, axis=1))))

    def csv_text(self) -> str:
        """The observations CSV; numbers are written so that they read back exactly."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in zip(*(c.tolist() for c in self.columns.values()), strict=True):
            writer.writerow([repr(v) if isinstance(v, float) else v for v in row])
        return out.getvalue()


def random_poses(rig: Rig, n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """n poses drawn evenly within the joint limits: joint name -> (n,) deg or mm."""
    return {j.name: rng.uniform(*j.limits, n) for j in rig.joints}


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
    """Stand still in pose after pose and measure.

    Args:
        truth: the machine.
        n_poses: how many poses.
        seed: the same seed gives the same poses and noise.
        poses: joint name -> (n_poses,) deg or mm; random within the limits when absent.
        prisms: which prisms are measured; all of the rig's when absent.
        prisms_per_pose: `all` of them in each pose, or `one` in turn.
        repeats: fixes of a prism in a pose.
        noise_mm: standard deviation of each coordinate; the rig's station noise (angles, distance, target) when absent.
        joint_noise: joint readings carry the rig's `sigma` and `resolution`, drawn once per pose: a standing joint
            reads the same at each of its fixes.
        sigma_columns: also give sigma_x_mm, sigma_y_mm, sigma_z_mm (without the joints' share).
        setup: station set-up, also decides where the machine stands; session: label.
        columns: further columns by pose (`payload_kg`, `temperature_degC`) -> (n_poses,); one that is given here takes
            the place of the simulated one.

    Returns:
        Columns `prism`, the joints, x, y, z, `pose`, `time_s`, `dwell_s`, `<joint>_dir`, `<joint>_rate` (0), and
        `setup`, `session` where given. Effects count time from the first row, and temperature from the mean.

    Raises:
        KeyError: unknown prism.
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
    # One fix a second in a pose; dwell counts from the end of the motion to the fix.
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
    """A machine whose effects count time from the first of these rows, and temperature from their mean."""
    if not truth.effects:
        return truth
    first_s = float(np.min(columns.get("time_s", np.zeros(1))))
    mean_degC = float(np.mean(columns.get("temperature_degC", np.zeros(1))))
    return replace_effects(truth, [effect.anchored(first_s, mean_degC) for effect in truth.effects])


def travel_m(rig: Rig, poses: Mapping[str, Floats]) -> dict[str, Floats]:
    """`<joint>_travel_m` of every prismatic joint -> (n,) m travelled from the first pose, visited in this order."""
    return {
        f"{j.name}_travel_m": np.cumsum(np.abs(np.diff(poses[j.name], prepend=poses[j.name][:1]))) / 1e3
        for j in rig.joints
        if j.kind == "prismatic"
    }


def prisms_mm(
    truth: RigTruth, prism: Strings, joints: Mapping[str, Floats], columns: Mapping[str, Floats], *, setup: str = ""
) -> Floats:
    """(n, 3) true positions of a prism for each row, in the station's frame.

    Args:
        truth: the machine. What its effects leave open of time and temperature should be anchored.
        prism: (n,) names.
        joints, columns, setup: as for `RigTruth.prism_mm`.
    """
    out = np.empty((len(prism), 3))
    for name in np.unique(prism):
        rows = prism == name
        values = {k: v[rows] for k, v in joints.items()}
        out[rows] = truth.prism_mm(str(name), values, {k: v[rows] for k, v in columns.items()}, setup=setup)
    return out


def _approach(
    rig: Rig, held: Mapping[str, Floats], before: Mapping[str, Floats], rng: np.random.Generator
) -> dict[str, Floats]:
    """By pose: when its first fix comes, how long it has stood, and from which side each joint came."""
    steps = {name: np.diff(values, prepend=before[name]) for name, values in held.items()}
    travel_s = np.max([np.abs(steps[j.name]) / (0.25 * j.max_rate) for j in rig.joints], axis=0)
    dwell_s = rng.uniform(5.0, 60.0, len(travel_s))
    out = {"time_s": np.cumsum(travel_s + dwell_s), "dwell_s": dwell_s}
    return out | {f"{name}_dir": np.sign(step) for name, step in steps.items()}


def read_joint(joint: Joint, values: Floats, rng: np.random.Generator) -> Floats:
    """(n,) what an encoder or transducer says of true values, deg or mm: with its random error, in whole steps."""
    noisy = values + rng.normal(0, joint.sigma, len(values))
    if joint.resolution == 0.0:
        return noisy
    return np.rint(noisy / joint.resolution) * joint.resolution


@dataclass(frozen=True)
class _Sighted:
    """Positions as a total station in the origin measures them, and how much each of its measurements errs."""

    hz: Floats
    zenith: Floats
    range_mm: Floats
    level_mm: Floats
    sigma_angle: float
    sigma_range_mm: Floats


def _sighted(station: Station, true_mm: Floats) -> _Sighted:
    x, y, z = true_mm.T
    level_mm = np.hypot(x, y)
    range_mm = np.maximum(np.hypot(level_mm, z), 1.0)
    return _Sighted(
        hz=np.arctan2(x, y),
        zenith=np.arctan2(level_mm, z),
        range_mm=range_mm,
        level_mm=level_mm,
        sigma_angle=station.angle_sigma_arcsec * ARCSEC,
        sigma_range_mm=station.distance_sigma_mm + station.distance_sigma_ppm * 1e-6 * range_mm,
    )


def _position(hz: Floats, zenith: Floats, range_: Floats | float) -> Floats:
    """(n, 3) what lies in a direction, as far off as is said."""
    sideways = range_ * np.sin(zenith)
    return np.column_stack([sideways * np.sin(hz), sideways * np.cos(hz), range_ * np.cos(zenith)])


def station_covariance_mm2(station: Station, true_mm: Floats) -> Floats:
    """(n, 3, 3) of the noise of positions (n, 3): a total station's range errs more than its circles do, or less."""
    sighted = _sighted(station, true_mm)
    # Directions of growing range, horizontal circle and zenith angle, each with its own spread.
    along = _position(sighted.hz, sighted.zenith, 1.0)
    round_about = np.column_stack([np.cos(sighted.hz), -np.sin(sighted.hz), np.zeros(len(true_mm))])
    downward = np.cross(round_about, along)
    across_mm = sighted.sigma_angle * np.stack([sighted.level_mm, sighted.range_mm], axis=1)
    spread = np.column_stack([sighted.sigma_range_mm, across_mm])
    root = np.stack([along, round_about, downward], axis=2) * spread[:, None]
    covariance: Floats = root @ root.transpose(0, 2, 1) + station.target_sigma_mm**2 * np.eye(3)
    return covariance


def coordinate_sigma_mm(covariance_mm2: Floats) -> Floats:
    """(n, 3) standard deviation of each coordinate, of covariances (n, 3, 3)."""
    sigma_mm: Floats = np.sqrt(np.diagonal(covariance_mm2, axis1=1, axis2=2))
    return sigma_mm


def station_measured_mm(station: Station, true_mm: Floats, rng: np.random.Generator) -> Floats:
    """(n, 3) positions (n, 3) as a total station in the origin measures them, with its random errors."""
    sighted, n = _sighted(station, true_mm), len(true_mm)
    hz, zenith = (a + rng.normal(0, sighted.sigma_angle, n) for a in (sighted.hz, sighted.zenith))
    range_mm = sighted.range_mm + rng.normal(0, 1.0, n) * sighted.sigma_range_mm
    shake_mm = rng.normal(0, 1.0, true_mm.shape) * station.target_sigma_mm
    return _position(hz, zenith, range_mm) + shake_mm
