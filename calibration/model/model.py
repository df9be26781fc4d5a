"""Data of a calibrated model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.effects.fitted import FittedEffect
from calibration.identification.identifiability import Identifiability
from calibration.identification.refinement import Prior
from calibration.kinematics.chain import Chain, Placement
from calibration.observations import Floats
from calibration.residual.conformal import StageIntervals
from calibration.residual.features import Features
from calibration.residual.learners import Residual
from calibration.residual.region import Region
from calibration.residual.selection import Trial
from calibration.rig.description import Rig


@dataclass(frozen=True)
class Outlier:
    """A fix far off the others: its row (from 0) in the observations and its error in sigma."""

    row: int
    sigma: float


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified constant.

    Attributes:
        name, unit: as `kinematics.Parameter`; values are deviations from nominal, mm or rad.
        kind: `row`, `prism` or `base`; a base's deviation is from the placement that the model holds.
        value, standard_error: posterior.
        prior_sigma: tolerance the fit used, infinity for none.
    """

    name: str
    unit: str
    kind: str
    value: float
    standard_error: float
    prior_sigma: float

    @property
    def pull(self) -> float:
        """Correction in units of its tolerance; 0 where there is none."""
        return self.value / self.prior_sigma if math.isfinite(self.prior_sigma) else 0.0


@dataclass(frozen=True)
class Coverage:
    """Extent of the training data.

    Attributes:
        fixes: prism -> number of fixes.
        ranges: joint -> lowest and highest reading, deg or mm.
        torques: joints whose torque was measured in most rows.
        payload: lowest and highest `payload_kg`; None where no row had it.
        loads: joint with an effect of its load -> lowest and highest, N m.
    """

    fixes: Mapping[str, int]
    ranges: Mapping[str, tuple[float, float]]
    torques: tuple[str, ...] = ()
    payload: tuple[float, float] | None = None
    loads: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class LearnedResidual:
    """A residual learner with what it needs to be used.

    Attributes:
        learner: the fitted learner.
        signals: optional columns among its features.
        prisms: prisms it was trained on; for others it estimates nothing.
        excess_variance_mm2: (3,) what held-out errors scatter beyond station and readings once it is added, along
            the axes of the base frame; takes the place of `excess_sigma_mm`.
        region: where it was trained; outside it fades.
    """

    learner: Residual
    signals: tuple[str, ...]
    prisms: tuple[str, ...]
    excess_variance_mm2: Floats
    region: Region

    def estimate(self, seen: Features, trained: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Estimate the residual, faded outside the region where it was trained.

        Args:
            seen: features of n rows.
            trained: (n,) True for prisms that it was trained on; elsewhere the estimate is zero.

        Returns:
            (n, 3) estimate in the base frame, mm; (n,) its weight, 0 to 1.
        """
        settled, weight = self.region.confine(seen)
        weight *= trained
        estimate_mm: Floats = weight[:, None] * self.learner.predict(settled)
        return estimate_mm, weight


@dataclass(frozen=True)
class CalibratedModel:
    """Data of a calibrated rig; `prediction`, `warnings`, `inverse` and `files` work on it.

    Attributes:
        rig, rig_text: the rig description and the TOML it was read from.
        placements: set-up -> where the base stands before the base parameters.
        values: (p,) all parameters, as `Chain.parameters` orders them, fitted together with the effects.
        covariance: (p + k, p + k) of them and of the coefficients of the effects.
        geometric_values: (p,) fitted without the effects; the same where there are none, but for a refitted base,
            which `values` have as it is beside the residual.
        nominal_values: (p,) with base and unknown prism offsets fitted and all else as in the rig file.
        prior, prior_scale: how the build tolerances were used.
        excess_sigma_mm: what the data scatter beyond station and readings, each axis, at stage effects.
        base_covariance: (b, b) covariance that the fixes a base was refitted on leave of its parameters, all others
            being known; part of `covariance`. None where the base was identified along with the others.
        repeat_sigma_mm: what repeats of a standstill scatter beyond the station's own sigma, each axis.
        effects_noise_mm: RMS 3-D noise at stage effects.
        identifiability: what the data determined.
        coverage: what they covered.
        effects: named physics on top of the kinematics.
        effects_reason: why these, or why none, a clause.
        joint_error_scale: error that kinematics and effects leave, as `joint_errors.joint_error_scale` finds it.
        outliers: fixes of the training data that were weighted out, by the numbers that warnings name their rows by.
        residual: the learner that was kept, if any.
        trials: learners that were compared.
        residual_reason: why there is a learner or none.
        intervals: how many formal standard deviations hold 90 % of errors.
        warnings: about the training data and the fit.
        fitted_rows: digests of the rows that were fitted (`observations.row_digests`); none of a model from before.
        provenance: data hash, versions, seed, search; text or numbers.
        prepared: objects made from the model once and kept with it, by their class; see `Predictor.of`.
    """

    rig: Rig
    rig_text: str
    placements: Mapping[str, Placement]
    values: Floats
    covariance: Floats
    geometric_values: Floats
    nominal_values: Floats
    prior: Prior
    prior_scale: float
    excess_sigma_mm: float
    repeat_sigma_mm: float
    effects_noise_mm: float
    identifiability: Identifiability
    coverage: Coverage
    effects: tuple[FittedEffect, ...] = ()
    effects_reason: str = "switched off"
    joint_error_scale: float = 0.0
    outliers: tuple[Outlier, ...] = ()
    residual: LearnedResidual | None = None
    trials: tuple[Trial, ...] = ()
    residual_reason: str = "not trained"
    intervals: StageIntervals = field(default_factory=StageIntervals)
    base_covariance: Floats | None = None
    warnings: tuple[str, ...] = ()
    fitted_rows: tuple[str, ...] = ()
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)
    prepared: dict[type, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def chain(self) -> Chain:
        """Kinematics at the model's set-ups."""
        return Chain(self.rig, self.placements)

    @property
    def known_noise_mm2(self) -> float:
        """Mean square 3-D noise of a fix by station, readings and repeats."""
        return max(self.effects_noise_mm**2 - 3.0 * self.excess_sigma_mm**2, 0.0)

    @property
    def noise_mm(self) -> float:
        """RMS 3-D error that the whole model, residual included, leaves of a held-out fix."""
        if self.residual is None:
            return self.effects_noise_mm
        return math.sqrt(self.known_noise_mm2 + float(self.residual.excess_variance_mm2.sum()))

    @property
    def parameters(self) -> tuple[ParameterEstimate, ...]:
        """Every identified constant with its standard error."""
        sigma = np.sqrt(np.diag(self.covariance))[: len(self.values)]
        return tuple(
            ParameterEstimate(p.name, p.unit, p.kind, float(value), float(error), p.prior_sigma * self.prior_scale)
            for p, value, error in zip(self.chain.parameters, self.values, sigma, strict=True)
        )
