"""Realistic noise: growing with range, shared within a standstill, wandering, with outliers; coarse encoders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig.description import Joint, Rig, Station

Floats = NDArray[np.float64]

ARCSEC = np.pi / 180 / 3600
_LOG_OUTLIER_SIZES = float(np.log(8.0)), float(np.log(60.0))  # of the size of outliers in units of the noise


@dataclass(frozen=True)
class NoiseSettings:
    """Settings of the measurement noise.

    Attributes:
        common_share: share of the variance that is common to all fixes of a standstill.
        wander_share, wander_poses: share of the variance of an error that wanders from pose to pose (air, tripod), and
            its correlation length in poses.
        excess_wander: standard deviation of an additional wandering error, in units of the noise; neither the
            covariance nor the stated sigma includes it.
        outliers: share of the fixes with errors of 8 to 60 times the noise.
        encoder_step_deg: resolution of the encoders, overriding the rig file; 0 for that of the rig file.
        jitter_s: standard deviation of the time at which joints are read, relative to the fix.
    """

    common_share: float = 0.2
    wander_share: float = 0.05
    wander_poses: float = 3.0
    excess_wander: float = 0.0
    outliers: float = 0.015
    encoder_step_deg: float = 0.0
    jitter_s: float = 0.005


@dataclass(frozen=True)
class FixNoise:
    """Noise of n fixes.

    Attributes:
        error_mm: (n, 3) measured minus true.
        covariance_mm2: (n, 3, 3) covariance of each fix, without outliers.
        is_outlier: (n,) mask of the outliers.
    """

    error_mm: Floats
    covariance_mm2: Floats
    is_outlier: NDArray[np.bool_]

    @property
    def sigma_mm(self) -> Floats:
        """The (n, 3) standard deviation of each coordinate."""
        return coordinate_sigma_mm(self.covariance_mm2)


def draw_noise(
    station: Station, true_mm: Floats, pose: NDArray[np.intp], settings: NoiseSettings, rng: np.random.Generator
) -> FixNoise:
    """Draw the noise of fixes.

    Args:
        station: random errors of the station, which determine shape and size of the noise.
        true_mm: (n, 3) true positions in the station's frame.
        pose: (n,) number of the standstill, increasing with time.
        settings: see NoiseSettings.
        rng: random generator.

    Raises:
        ValueError: a share is not between 0 and 1, or a size is negative.
    """
    _check(settings)
    covariance = station_covariance_mm2(station, true_mm)
    own = station_measured_mm(station, true_mm, rng) - true_mm
    _, first, which = np.unique(pose, return_index=True, return_inverse=True)
    shared = (station_measured_mm(station, true_mm[first], rng) - true_mm[first])[which]
    fresh = station_measured_mm(station, true_mm[first], rng) - true_mm[first]
    wander = _wandering(fresh, settings.wander_poses)
    alone = 1.0 - settings.common_share - settings.wander_share
    shift = np.sqrt(alone) * own + np.sqrt(settings.common_share) * shared
    shift += np.sqrt(settings.wander_share) * wander[which]
    is_outlier = rng.random(len(shift)) < settings.outliers
    direction = rng.normal(size=shift.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    noise_mm = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    off = np.exp(rng.uniform(*_LOG_OUTLIER_SIZES, len(shift))) * noise_mm
    shift = np.where(is_outlier[:, None], direction * off[:, None], shift)
    if settings.excess_wander > 0.0:
        fresh = station_measured_mm(station, true_mm[first], rng) - true_mm[first]
        shift += settings.excess_wander * _wandering(fresh, settings.wander_poses)[which]
    return FixNoise(shift, covariance, is_outlier)


def _wandering(fresh: Floats, poses: float) -> Floats:
    """Return (n, 3) correlated errors with the variance of the independent errors `fresh` (n, 3).

    `poses` is the correlation length in poses.
    """
    keep = np.exp(-1.0 / poses)
    out = np.empty_like(fresh)
    for i in range(len(fresh)):
        out[i] = fresh[i] if i == 0 else keep * out[i - 1] + np.sqrt(1.0 - keep**2) * fresh[i]
    return out


def read_joints(
    rig: Rig,
    joints: Mapping[str, Floats],
    columns: Mapping[str, Floats],
    settings: NoiseSettings,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Return readings of encoders and transducers, taken slightly before or after the fix.

    Args:
        rig: description with the joints' sigma and resolution.
        joints: joint name -> (n,) true value at the fix, deg or mm.
        columns: `<joint>_rate` of each joint -> (n,).
        settings: see NoiseSettings.
        rng: random generator.
    """
    late_s = rng.normal(0.0, settings.jitter_s, len(next(iter(joints.values()))))
    out = {}
    for joint in rig.joints:
        read = read_joint(joint, joints[joint.name] + columns[f"{joint.name}_rate"] * late_s, rng)
        if joint.kind == "revolute" and settings.encoder_step_deg > 0.0:
            read = np.rint(read / settings.encoder_step_deg) * settings.encoder_step_deg
        out[joint.name] = read
    return out


def _check(settings: NoiseSettings) -> None:
    shares = settings.common_share, settings.wander_share, settings.outliers
    if min(shares) < 0.0 or settings.common_share + settings.wander_share > 1.0 or settings.outliers > 1.0:
        raise ValueError("shares of noise must be from 0 to 1, and the shares of the variance together at most 1")
    if min(settings.encoder_step_deg, settings.jitter_s, settings.excess_wander) < 0.0 or settings.wander_poses <= 0.0:
        raise ValueError("sizes of noise must not be negative, and wander_poses must be above 0")


def read_joint(joint: Joint, values: Floats, rng: np.random.Generator) -> Floats:
    """Return the (n,) readings of an encoder or transducer, with random error and rounded to its resolution.

    Args:
        joint: description of the joint.
        values: (n,) true values, deg or mm.
        rng: random generator.
    """
    noisy = values + rng.normal(0, joint.sigma, len(values))
    if joint.resolution == 0.0:
        return noisy
    return np.rint(noisy / joint.resolution) * joint.resolution


@dataclass(frozen=True)
class _Sighted:
    """Polar coordinates of positions seen from a total station at the origin, and the sigma of each measurement."""

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
    """Return the (n, 3) positions at a direction and range."""
    sideways = range_ * np.sin(zenith)
    return np.column_stack([sideways * np.sin(hz), sideways * np.cos(hz), range_ * np.cos(zenith)])


def station_covariance_mm2(station: Station, true_mm: Floats) -> Floats:
    """Return the (n, 3, 3) covariance of the noise at (n, 3) positions, from a station's range and circle errors."""
    sighted = _sighted(station, true_mm)
    # Directions of increasing range, horizontal circle and zenith angle, each with its own sigma
    along = _position(sighted.hz, sighted.zenith, 1.0)
    round_about = np.column_stack([np.cos(sighted.hz), -np.sin(sighted.hz), np.zeros(len(true_mm))])
    downward = np.cross(round_about, along)
    across_mm = sighted.sigma_angle * np.stack([sighted.level_mm, sighted.range_mm], axis=1)
    spread = np.column_stack([sighted.sigma_range_mm, across_mm])
    root = np.stack([along, round_about, downward], axis=2) * spread[:, None]
    covariance: Floats = root @ root.transpose(0, 2, 1) + station.target_sigma_mm**2 * np.eye(3)
    return covariance


def coordinate_sigma_mm(covariance_mm2: Floats) -> Floats:
    """Return the (n, 3) standard deviation of each coordinate for (n, 3, 3) covariances."""
    sigma_mm: Floats = np.sqrt(np.diagonal(covariance_mm2, axis1=1, axis2=2))
    return sigma_mm


def station_measured_mm(station: Station, true_mm: Floats, rng: np.random.Generator) -> Floats:
    """Return (n, 3) positions as measured by a total station at the origin, with its random errors.

    Args:
        station: random errors of the station.
        true_mm: (n, 3) true positions in the station's frame.
        rng: random generator.
    """
    sighted, n = _sighted(station, true_mm), len(true_mm)
    hz, zenith = (a + rng.normal(0, sighted.sigma_angle, n) for a in (sighted.hz, sighted.zenith))
    range_mm = sighted.range_mm + rng.normal(0, 1.0, n) * sighted.sigma_range_mm
    shake_mm = rng.normal(0, 1.0, true_mm.shape) * station.target_sigma_mm
    return _position(hz, zenith, range_mm) + shake_mm
