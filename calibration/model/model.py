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
    """An outlying fix: its row (from 0) in the observations and its error in sigma."""

    row: int
    sigma: float


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified constant.

    Attributes:
        name: for example `row4.theta`, `prism.r.y`, `base[s1].rx` (`base.rx` if the set-up has no name).
        unit: `mm` or `rad`.
        kind: `row`, `prism` or `base`.
        value, standard_error: deviation from the nominal value, for a base from the placement in the model, and its
            standard deviation.
        prior_sigma: tolerance used in the fit, infinity for none.
    """

    name: str
    unit: str
    kind: str
    value: float
    standard_error: float
    prior_sigma: float

    @property
    def pull(self) -> float:
        """Correction in units of its tolerance; 0 if it has no tolerance."""
        return self.value / self.prior_sigma if math.isfinite(self.prior_sigma) else 0.0


@dataclass(frozen=True)
class TrainingExtent:
    """Extent of the training data.

    Attributes:
        fixes: prism -> number of fixes.
        ranges: joint -> lowest and highest reading, deg or mm.
        torques: joints whose torque was measured in most rows.
        payload: lowest and highest `payload_kg`; None if no row had it.
        loads: joint with an effect of its load -> lowest and highest load, N m.
    """

    fixes: Mapping[str, int]
    ranges: Mapping[str, tuple[float, float]]
    torques: tuple[str, ...] = ()
    payload: tuple[float, float] | None = None
    loads: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class LearnedResidual:
    """A residual learner with all data needed to use it.

    Attributes:
        learner: the fitted learner.
        signals: optional columns among its features.
        prisms: prisms on which it was trained; the estimate for others is zero.
        excess_variance_mm2: (3,) variance of held-out errors with the learner in excess of station and readings, along
            the axes of the base frame; replaces `excess_sigma_mm`.
        region: region in which it was trained; outside it the estimate fades to zero.
    """

    learner: Residual
    signals: tuple[str, ...]
    prisms: tuple[str, ...]
    excess_variance_mm2: Floats
    region: Region

    def estimate(self, seen: Features, trained: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Estimate the residual, fading to zero outside the region of the training data.

        Args:
            seen: features of n rows.
            trained: (n,) True for prisms on which it was trained; elsewhere the estimate is zero.

        Returns:
            (n, 3) estimate in the base frame, mm; and its (n,) weight, 0 to 1.
        """
        settled, weight = self.region.confine(seen)
        weight *= trained
        estimate_mm: Floats = weight[:, None] * self.learner.predict(settled)
        return estimate_mm, weight


@dataclass(frozen=True)
class CalibratedModel:
    """Data of a calibrated rig; `prediction`, `warnings`, `inverse` and `files` work on it.

    Attributes:
        rig, rig_text: the rig description and its TOML text.
        placements: set-up -> placement of the base, to which the base parameters are corrections.
        values: (p,) all parameters in the order of `Chain.parameters`, fitted together with the effects.
        covariance: (p + k, p + k) covariance of the parameters and of the coefficients of the effects.
        geometric_values: (p,) parameters fitted without the effects. Without effects they equal `values`, except for a
            refitted base, which `values` have as fitted together with the residual.
        nominal_values: (p,) base and unknown prism offsets as fitted, all others as in the rig file.
        prior, prior_scale: how the build tolerances were used.
        excess_sigma_mm: scatter of the data in excess of station and readings at stage effects, per axis.
        base_covariance: (b, b) covariance of the parameters of a refitted base given all other parameters; a part of
            `covariance`. None if the base was identified together with the other parameters.
        repeat_sigma_mm: scatter of repeats of a standstill in excess of the station's sigma, per axis.
        effects_noise_mm: RMS 3-D noise at stage effects.
        identifiability: which parameters the data determined.
        coverage: extent of the training data.
        effects: named physical effects in addition to the kinematics.
        effects_reason: a clause that explains why there are these effects or none.
        joint_error_scale: remaining error of kinematics and effects, from `joint_errors.joint_error_scale`.
        outliers: fixes of the training data that were downweighted, by the row numbers used in warnings.
        residual: the learner that was kept, if any.
        trials: results of the learners that were compared.
        residual_reason: why there is a learner or none.
        intervals: numbers of formal standard deviations that contain 90 % of errors.
        warnings: warnings about the training data and the fit.
        fitted_rows: digests of the fitted rows (`observations.row_digests`); empty for older models.
        provenance: data hash, versions, seed, search; text or numbers.
        prepared: objects that are made once from the model and kept with it, by class; see `Predictor.of`.
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
    coverage: TrainingExtent
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
        """Mean square 3-D noise of a fix due to station, readings and repeats."""
        return max(self.effects_noise_mm**2 - 3.0 * self.excess_sigma_mm**2, 0.0)

    @property
    def noise_mm(self) -> float:
        """RMS 3-D error of the whole model, including its residual learner, for a held-out fix."""
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
