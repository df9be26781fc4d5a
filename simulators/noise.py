"""Noise as it occurs: growing with range, shared by a standstill, wandering, with outliers; coarse encoders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig, Station
from simulators.dataset import coordinate_sigma_mm, read_joint, station_covariance_mm2, station_measured_mm

Floats = NDArray[np.float64]

_LOG_OUTLIER_SIZES = float(np.log(8.0)), float(np.log(60.0))  # of their size over the noise


@dataclass(frozen=True)
class NoiseSettings:
    """How measurements err.

    Attributes:
        rms_mm: 3-D RMS of the station's noise in the mean over the fixes; as the rig file says where None. It grows
            with the range and differs between directions as the rig's instrument has it.
        common_share: of the variance, common to all fixes of a standstill.
        wander_share, wander_poses: of the variance, in an error that wanders from pose to pose (air, tripod), and over
            how many poses it forgets.
        outliers: share of the fixes that are 8 to 60 times the noise off.
        misjudged: the stated sigma is wrong by a factor from 1 - this to 1 + this.
        encoder_step_deg: encoders read in steps of this size, whatever the rig file says; 0 as the rig file says.
        jitter_s: standard deviation of the instant at which joints are read, against that of the fix.
    """

    rms_mm: float | None = None
    common_share: float = 0.2
    wander_share: float = 0.05
    wander_poses: float = 3.0
    outliers: float = 0.015
    misjudged: float = 0.05
    encoder_step_deg: float = 0.0
    jitter_s: float = 0.005


@dataclass(frozen=True)
class FixNoise:
    """Noise of n fixes.

    Attributes:
        shift_mm: (n, 3) measured minus true.
        covariance_mm2: (n, 3, 3) of each fix, without outliers.
        is_outlier: (n,).
    """

    shift_mm: Floats
    covariance_mm2: Floats
    is_outlier: NDArray[np.bool_]

    @property
    def sigma_mm(self) -> Floats:
        """(n, 3) standard deviation of each coordinate."""
        return coordinate_sigma_mm(self.covariance_mm2)


def draw_noise(
    station: Station, true_mm: Floats, pose: NDArray[np.intp], settings: NoiseSettings, rng: np.random.Generator
) -> FixNoise:
    """Noise of fixes.

    Args:
        station: its random errors give the noise its shape, and its size unless the settings do.
        true_mm: (n, 3) true places in the station's frame.
        pose: (n,) number of the standstill, rising with the time.
        settings: see there.
        rng: source.

    Raises:
        ValueError: shares that are no shares, or a negative size.
    """
    _check(settings)
    covariance = station_covariance_mm2(station, true_mm)
    own = station_measured_mm(station, true_mm, rng) - true_mm
    stands, first, which = np.unique(pose, return_index=True, return_inverse=True)
    shared = (station_measured_mm(station, true_mm[first], rng) - true_mm[first])[which]
    fresh = station_measured_mm(station, true_mm[first], rng) - true_mm[first]
    keep = np.exp(-1.0 / settings.wander_poses)
    wander = np.empty_like(fresh)
    state = fresh[0]
    for i in range(len(stands)):
        state = fresh[i] if i == 0 else keep * state + np.sqrt(1.0 - keep**2) * fresh[i]
        wander[i] = state
    alone = 1.0 - settings.common_share - settings.wander_share
    shift = np.sqrt(alone) * own + np.sqrt(settings.common_share) * shared
    shift += np.sqrt(settings.wander_share) * wander[which]
    if settings.rms_mm is not None:
        scale = settings.rms_mm / float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2))))
        shift, covariance = shift * scale, covariance * scale**2
    is_outlier = rng.random(len(shift)) < settings.outliers
    direction = rng.normal(size=shift.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    noise_mm = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    off = np.exp(rng.uniform(*_LOG_OUTLIER_SIZES, len(shift))) * noise_mm
    shift = np.where(is_outlier[:, None], direction * off[:, None], shift)
    return FixNoise(shift, covariance, is_outlier)


def read_joints(
    rig: Rig,
    joints: Mapping[str, Floats],
    columns: Mapping[str, Floats],
    settings: NoiseSettings,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """What encoders and transducers say, read a little before or after the fix.

    Args:
        rig: joints' sigma and resolution.
        joints: joint name -> (n,) at the fix, deg or mm.
        columns: `<joint>_rate` of each -> (n,).
        settings: see there.
        rng: source.
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
    shares = settings.common_share, settings.wander_share, settings.outliers, settings.misjudged
    if min(shares) < 0.0 or settings.common_share + settings.wander_share > 1.0 or settings.outliers > 1.0:
        raise ValueError("shares of noise are from 0 to 1, those of the variance together at most 1")
    sizes = (settings.rms_mm or 0.0), settings.encoder_step_deg, settings.jitter_s
    if min(sizes) < 0.0 or settings.wander_poses <= 0.0:
        raise ValueError("sizes of noise are not negative, and a wander lasts more than 0 poses")
