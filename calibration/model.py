"""The calibrated model: everything that turns joint readings into positions with a known accuracy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.doubts import doubts
from calibration.effects.fitted import FittedEffect
from calibration.errors import CalibrationError, UnsafeError
from calibration.identification.identifiability import Identifiability
from calibration.identification.refinement import Prior
from calibration.kernels.machine import Machine
from calibration.kinematics import Chain, Linearisation, Placement
from calibration.observations import Floats, Observations
from calibration.prediction import Prediction, Predictor
from calibration.residual.conformal import Intervals
from calibration.residual.features import Features
from calibration.residual.hybrid import Residual, Trial
from calibration.residual.region import Region
from calibration.rig import Rig

OUTLIER_SIGMA = 5.0


@dataclass(frozen=True)
class Outlier:
    """A fix that does not belong to the rest: its row (from 0) in the observations and its error in sigma."""

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
    """What the model was trained on.

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
        """(n, 3) estimate of the residual in the base frame, mm, as far as it counts; (n,) how much it does, 0 to 1.

        Args:
            seen: features of n rows.
            trained: (n,) which are of prisms that it was trained on; elsewhere it does not count.
        """
        settled, weight = self.region.settle(seen)
        weight *= trained
        estimate_mm: Floats = weight[:, None] * self.learner.predict(settled)
        return estimate_mm, weight


@dataclass(frozen=True)
class CalibratedModel:
    """A rig with identified parameters.

    Attributes:
        rig, rig_text: the rig description and the TOML it was read from.
        placements: set-up -> where the base stands before the base parameters.
        values: (p,) all parameters, as `Chain.parameters` orders them, fitted together with the effects.
        covariance: (p + k, p + k) of them and of the coefficients of the effects.
        geometric_values: (p,) fitted without the effects; the same where there are none, but for a refitted base,
            which `values` have as it is beside the residual.
        nominal_values: (p,) with base and unknown prism offsets fitted and nothing else.
        prior, prior_scale: how the build tolerances were used.
        excess_sigma_mm: what the data scatter beyond station and readings, each axis, at stage effects.
        base_covariance: (b, b) what the fixes that a base was refitted on leave uncertain of its parameters, whatever
            all the others are; part of `covariance`. None where the base was identified along with them.
        repeat_sigma_mm: what repeats of a standstill scatter beyond the station's own sigma, each axis.
        effects_noise_mm: RMS 3-D noise at stage effects.
        identifiability: what the data determined.
        coverage: what they covered.
        effects: named physics on top of the kinematics.
        effects_reason: why these, or why none, a clause.
        joint_error_scale: what kinematics and effects lack, as `calibration.accuracy.joint_error_scale` finds it.
        outliers: fixes of the training data that were weighted out.
        residual: the learner that was kept, if any.
        trials: learners that were compared.
        residual_reason: why there is a learner or none.
        intervals: how many standard deviations hold 90 % of errors.
        warnings: about the training data and the fit.
        provenance: data hash, versions, seed, search; text or numbers.
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
    intervals: Intervals = field(default_factory=Intervals)
    base_covariance: Floats | None = None
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)

    @cached_property
    def chain(self) -> Chain:
        """Kinematics at the model's set-ups."""
        return Chain(self.rig, self.placements)

    @cached_property
    def predictor(self) -> Predictor:
        """The model as it predicts."""
        return Predictor(self)

    @property
    def known_noise_mm2(self) -> float:
        """Mean square 3-D noise of a fix that station, readings and repeats account for."""
        return max(self.effects_noise_mm**2 - 3.0 * self.excess_sigma_mm**2, 0.0)

    @property
    def noise_mm(self) -> float:
        """RMS 3-D noise: what the whole model, residual included, leaves of a held-out fix."""
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

    def nominal_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions of the nominal rig. Raises UnsafeError as `check`."""
        self.check(observations)
        return Machine(self.chain, self.nominal_values).locate(self.chain.bind(observations)).position_mm

    def geometric_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions by the kinematics identified without effects. Raises UnsafeError as `check`."""
        self.check(observations)
        return Machine(self.chain, self.geometric_values).locate(self.chain.bind(observations)).position_mm

    def effects_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions by kinematics and effects. Raises UnsafeError as `check`."""
        self.check(observations)
        return self.predictor.effects_mm(observations)

    def corrected(self, observations: Observations) -> Observations:
        """The observations with the joints where the effects have them, and not where they read."""
        return self.predictor.corrected(observations)

    def residual_features(self, observations: Observations, signals: Sequence[str]) -> Features:
        """What a residual learner sees, effects taken into account."""
        return self.predictor.features(observations, signals)

    def correction_mm(self, observations: Observations) -> Floats:
        """(n, 3) what the residual learner adds, in the station's frame; zero for prisms it was not trained on."""
        return self.predictor.correction(observations)[0]

    def to_station(self, observations: Observations, vector_mm: Floats) -> Floats:
        """(n, 3) vectors of the base frame turned into the station's."""
        return (self.predictor.rotations(observations) @ vector_mm[:, :, None])[:, :, 0]

    def to_base(self, observations: Observations, vector_mm: Floats) -> Floats:
        """(n, 3) vectors of the station's frame turned into the base frame."""
        return (self.predictor.rotations(observations).transpose(0, 2, 1) @ vector_mm[:, :, None])[:, :, 0]

    def predict(self, observations: Observations, executor: Executor | None = None) -> Prediction:
        """Positions and the standard deviation that a fix of them has.

        Args:
            observations: n rows.
            executor: threads among which many rows are divided; the result does not depend on it.

        Raises:
            UnsafeError: a set-up that the model does not know.
            CalibrationError: a position or its standard deviation is not a finite number.
        """
        self.check(observations)
        return self.predictor.predict(observations, executor)

    def base_mm(self, observations: Observations) -> Floats:
        """Where the prisms are in the base frame, by the whole model.

        What effects add to fixes alone (of station, prisms and clocks), and how they move the base, is no part of it.

        Returns:
            (n, 3) mm.

        Raises:
            UnsafeError: a set-up that the model does not know.
            CalibrationError: a place is not a finite number.
        """
        self.check(observations)
        return self.predictor.base_mm(observations)

    def deviations(self, observations: Observations) -> Floats:
        """(n,) errors of stage effects in sigma (Mahalanobis length).

        Raises:
            UnsafeError: as `check`.
            CalibrationError: an uncertainty that is no machine's.
        """
        self.check(observations)
        position, known, parameters = self.predictor.covariances(observations)
        error = observations.position_mm - position
        try:
            factor = np.linalg.cholesky(known + parameters + self.excess_sigma_mm**2 * np.eye(3))
        except np.linalg.LinAlgError as failure:
            raise CalibrationError(
                "the model's uncertainty of a position is so large that rounding hides its noise; calibrate again"
            ) from failure
        whitened = np.linalg.solve(factor, error[:, :, None])[:, :, 0]
        return np.asarray(np.linalg.norm(whitened, axis=1), dtype=np.float64)

    def find_outliers(self, observations: Observations) -> tuple[Outlier, ...]:
        """Fixes farther from stage effects than noise and parameters explain."""
        size = self.deviations(observations)
        return tuple(Outlier(int(row), float(size[row])) for row in np.flatnonzero(size > OUTLIER_SIGMA))

    def linearise(self, observations: Observations) -> tuple[Linearisation, Floats]:
        """Stage effects with its derivatives, and (n, 3, p + k) those by parameters and coefficients, mm per unit."""
        return self.predictor.linearise(observations)

    def unknown_variance(self, observations: Observations) -> Floats:
        """(n, joints) variance of the joints' values by effects left out for want of a column, deg^2 or mm^2."""
        return self.predictor.unknown_variance(observations)

    def unexplained_mm2(self, observations: Observations, variance_mm2: Floats) -> Floats:
        """What is left of a learner's squared errors when the known noise is taken out.

        The training rows' errors are those of kinematics that were fitted to them, smaller by the parameters' share
        than what new rows see; predictions add that share.

        Args:
            observations: the training rows.
            variance_mm2: (3,) squared errors on them, along the axes of the base frame.

        Returns:
            (3,) along the same axes, not negative.
        """
        _, known, parameters = self.predictor.covariances(observations)
        rotation = self.predictor.rotations(observations)
        parameters *= self.random_share(float(variance_mm2.sum()))
        in_base = rotation.transpose(0, 2, 1) @ (known - parameters) @ rotation
        left: Floats = np.maximum(variance_mm2 - np.diagonal(in_base, axis1=1, axis2=2).mean(axis=0), 0.0)
        return left

    def random_share(self, variance_mm2: float) -> float:
        """Share of the parameters' covariance that noise makes, and not what a learner corrects.

        The learner is trained on what these very parameters leave, and makes good what structure did to them.
        """
        return min(1.0, variance_mm2 / max(self.effects_noise_mm**2, 1e-12))

    def unknown_setups(self, observations: Observations) -> tuple[str, ...]:
        """Set-ups of the observations that the model has no base for."""
        return tuple(sorted(set(observations.setup.tolist()) - set(self.placements)))

    def check(self, observations: Observations) -> None:
        """Raise UnsafeError where the observations come from a set-up that the model does not know."""
        unknown = self.unknown_setups(observations)
        if unknown:
            known = ", ".join(repr(s) for s in sorted(self.placements))
            blank = "" if unknown[0] else " (no setup in the row)"
            raise UnsafeError(
                f"set-up {unknown[0]!r}{blank} is unknown to the model (known: {known}); its base transform would be a "
                f"guess. Use --refit-base to fit it on these fixes"
            )

    def doubts(self, observations: Observations) -> tuple[str, ...]:
        """Warnings about using the model for these observations: what it was never trained on."""
        return tuple(doubts(self, observations))

    def to_files(self) -> dict[str, bytes]:
        """The model as named files, `manifest.json` with their SHA-256 among them."""
        from calibration.model_format import write_model

        return write_model(self)

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> CalibratedModel:
        """Inverse of `to_files`.

        Raises:
            ModelError: truncated, edited, of another version, or not a model.
        """
        from calibration.model_format import read_model

        return read_model(files)
