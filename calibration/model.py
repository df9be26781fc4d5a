"""The calibrated model: everything that turns joint readings into positions with a known accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import (
    FittedEffect,
    coefficient_values,
    corrected,
    fitted_additions,
    left_out,
    unknown_variance,
)
from calibration.errors import UnsafeError
from calibration.identification.additions import Additions
from calibration.identification.identifiability import Identifiability
from calibration.identification.refinement import Prior
from calibration.identification.samples import (
    covariance_by_joints,
    joint_rates,
    reading_covariance,
    station_covariance,
)
from calibration.kinematics import Chain, Linearisation, Placement
from calibration.observations import Floats, Observations
from calibration.residual.features import Features, features, missing_signals
from calibration.residual.hybrid import Residual, Trial
from calibration.rig import Rig

_OUTLIER_SIGMA = 5.0
_OUTSIDE = 0.1  # of a joint's trained range


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
    """

    fixes: Mapping[str, int]
    ranges: Mapping[str, tuple[float, float]]
    torques: tuple[str, ...] = ()


@dataclass(frozen=True)
class LearnedResidual:
    """A residual learner with what it needs to be used.

    Attributes:
        learner: the fitted learner.
        signals: optional columns among its features.
        prisms: prisms it was trained on; for others it estimates nothing.
        excess_variance_mm2: (3,) what held-out errors scatter beyond station and readings once it is added, along
            the axes of the base frame; takes the place of `excess_sigma_mm`.
    """

    learner: Residual
    signals: tuple[str, ...]
    prisms: tuple[str, ...]
    excess_variance_mm2: Floats


@dataclass(frozen=True)
class Prediction:
    """Positions with their uncertainty.

    Attributes:
        position_mm: (n, 3) in the station's frame.
        sigma_mm: (n, 3) standard deviation of a fix about it: parameters, readings, timing, station, effects left out
            for want of a column, what the model lacks.
    """

    position_mm: Floats
    sigma_mm: Floats


@dataclass(frozen=True)
class CalibratedModel:
    """A rig with identified parameters.

    Attributes:
        rig, rig_text: the rig description and the TOML it was read from.
        placements: set-up -> where the base stands before the base parameters.
        values: (p,) all parameters, as `Chain.parameters` orders them, fitted together with the effects.
        covariance: (p + k, p + k) of them and of the coefficients of the effects.
        geometric_values: (p,) fitted without the effects; the same where there are none.
        nominal_values: (p,) with base and unknown prism offsets fitted and nothing else.
        prior, prior_scale: how the build tolerances were used.
        excess_sigma_mm: what the data scatter beyond station and readings, each axis, at stage effects.
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
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, str | int | float] = field(default_factory=dict)

    @cached_property
    def chain(self) -> Chain:
        """Kinematics at the model's set-ups."""
        return Chain(self.rig, self.placements)

    @property
    def noise_mm(self) -> float:
        """RMS 3-D noise: what the whole model, residual included, leaves of a held-out fix."""
        if self.residual is None:
            return self.effects_noise_mm
        known = self.effects_noise_mm**2 - 3.0 * self.excess_sigma_mm**2
        return math.sqrt(max(known, 0.0) + float(self.residual.excess_variance_mm2.sum()))

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
        return self.chain.positions_mm(self.nominal_values, self.chain.bind(observations))

    def geometric_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions by the kinematics identified without effects. Raises UnsafeError as `check`."""
        self.check(observations)
        return self.chain.positions_mm(self.geometric_values, self.chain.bind(observations))

    def effects_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions by kinematics and effects. Raises UnsafeError as `check`."""
        self.check(observations)
        return self.chain.positions_mm(self.values, self.chain.bind(self.corrected(observations)))

    def corrected(self, observations: Observations) -> Observations:
        """The observations with the joints where the effects have them, and not where they read."""
        return self._corrected(observations)[0] if self.effects else observations

    def _corrected(self, observations: Observations) -> tuple[Observations, Additions]:
        additions = fitted_additions(self.effects, self._situation(observations))
        change = additions.change(coefficient_values(self.effects), len(self.rig.joints))
        return corrected(observations, change, self.rig.joint_names), additions

    def residual_features(self, observations: Observations, signals: Sequence[str]) -> Features:
        """What a residual learner sees, effects taken into account."""
        return features(self.chain, self.values, self.corrected(observations), signals)

    def correction_mm(self, observations: Observations) -> Floats:
        """(n, 3) what the residual learner adds, in the station's frame; zero for prisms it was not trained on."""
        correction = np.zeros((len(observations), 3))
        if self.residual is None or len(observations) == 0:
            return correction
        known = np.isin(observations.prism, self.residual.prisms)
        if not known.any():
            return correction
        rows = observations.select(known)
        seen = self.residual_features(rows, self.residual.signals)
        correction[known] = self.to_station(rows, self.residual.learner.predict(seen))
        return correction

    def to_station(self, observations: Observations, vector_mm: Floats) -> Floats:
        """(n, 3) vectors of the base frame turned into the station's."""
        return (self._base_rotations(observations) @ vector_mm[:, :, None])[:, :, 0]

    def to_base(self, observations: Observations, vector_mm: Floats) -> Floats:
        """(n, 3) vectors of the station's frame turned into the base frame."""
        return (self._base_rotations(observations).transpose(0, 2, 1) @ vector_mm[:, :, None])[:, :, 0]

    def _base_rotations(self, observations: Observations) -> Floats:
        rotation = np.array([self.chain.base(self.values, s).rotation for s in range(len(self.chain.setups))])
        return rotation[self.chain.bind(observations).setup]

    def predict(self, observations: Observations) -> Prediction:
        """Positions and the standard deviation that a fix of them has.

        Raises:
            UnsafeError: a set-up that the model does not know.
        """
        self.check(observations)
        position, known, parameters = self._covariances(observations)
        rotation = self._base_rotations(observations)
        excess = np.full((len(observations), 3), self.excess_sigma_mm**2)
        if self.residual is not None:
            learned = np.isin(observations.prism, self.residual.prisms)
            excess[learned] = self.residual.excess_variance_mm2
            parameters[learned] *= self._random_share(self.noise_mm**2)
        covariance = known + parameters + (rotation * excess[:, None, :]) @ rotation.transpose(0, 2, 1)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return Prediction(position + self.correction_mm(observations), sigma)

    def deviations(self, observations: Observations) -> Floats:
        """(n,) errors of stage effects in sigma (Mahalanobis length)."""
        self.check(observations)
        position, known, parameters = self._covariances(observations)
        error = observations.position_mm - position
        factor = np.linalg.cholesky(known + parameters + self.excess_sigma_mm**2 * np.eye(3))
        whitened = np.linalg.solve(factor, error[:, :, None])[:, :, 0]
        return np.asarray(np.linalg.norm(whitened, axis=1), dtype=np.float64)

    def find_outliers(self, observations: Observations) -> tuple[Outlier, ...]:
        """Fixes farther from stage effects than noise and parameters explain."""
        size = self.deviations(observations)
        return tuple(Outlier(int(row), float(size[row])) for row in np.flatnonzero(size > _OUTLIER_SIGMA))

    def _covariances(self, observations: Observations) -> tuple[Floats, Floats, Floats]:
        """Positions of stage effects, covariance of fix and readings, covariance by parameters and coefficients."""
        lin, jacobian = self.linearise(observations)
        known = station_covariance(self.rig, lin.position_mm, observations.sigma_mm)
        known = known + reading_covariance(self.rig, lin.joint_jacobian, joint_rates(self.rig, observations))
        known = known + self.repeat_sigma_mm**2 * np.eye(3)
        known = known + covariance_by_joints(lin.joint_jacobian, self.unknown_variance(observations))
        return lin.position_mm, known, jacobian @ self.covariance @ jacobian.transpose(0, 2, 1)

    def linearise(self, observations: Observations) -> tuple[Linearisation, Floats]:
        """Stage effects with its derivatives, and (n, 3, p + k) those by parameters and coefficients, mm per unit."""
        if not self.effects:
            lin = self.chain.linearise(self.values, self.chain.bind(observations))
            return lin, lin.jacobian
        true, additions = self._corrected(observations)
        lin = self.chain.linearise(self.values, self.chain.bind(true))
        by_coefficient = additions.moved_mm(lin.joint_jacobian)
        return lin, np.concatenate([lin.jacobian, by_coefficient], axis=2)

    def unknown_variance(self, observations: Observations) -> Floats:
        """(n, joints) variance of the joints' values by effects left out for want of a column, deg^2 or mm^2."""
        return unknown_variance(self.effects, self._situation(observations))

    def _situation(self, observations: Observations) -> Situation:
        return Situation(self.chain, self.values, observations)

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
        _, known, parameters = self._covariances(observations)
        rotation = self._base_rotations(observations)
        parameters *= self._random_share(float(variance_mm2.sum()))
        in_base = rotation.transpose(0, 2, 1) @ (known - parameters) @ rotation
        left: Floats = np.maximum(variance_mm2 - np.diagonal(in_base, axis1=1, axis2=2).mean(axis=0), 0.0)
        return left

    def _random_share(self, variance_mm2: float) -> float:
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
            raise UnsafeError(
                f"set-up {unknown[0]!r} is unknown to the model (known: {known}); its base transform would be a guess. "
                f"Use --refit-base to fit it on these fixes"
            )

    def doubts(self, observations: Observations) -> tuple[str, ...]:
        """Warnings about using the model for these observations: what it was never trained on."""
        found = [
            f"prism {prism!r} was never measured in training; its offset is the nominal one"
            for prism in sorted(set(observations.prism.tolist()))
            if not self.coverage.fixes.get(prism)
        ]
        for name, (low, high) in self.coverage.ranges.items():
            joint = self.rig.joint(name)
            margin = max(_OUTSIDE * (high - low), 1.0 if joint.kind == "revolute" else 10.0)
            above = observations.joints[name] - (low - margin)
            if joint.kind == "revolute":
                above %= 360.0
            outside = int(((above < 0.0) | (above > high - low + 2.0 * margin)).sum())
            if outside:
                found.append(
                    f"{name}: {outside} of {len(above)} readings are outside the {low:.1f} .. {high:.1f} {joint.unit} "
                    f"of the training data"
                )
        found += left_out(self.effects, self._situation(observations))
        found += self._other_torques(observations)
        if self.residual is not None:
            missing = missing_signals(self.rig, observations, self.residual.signals)
            if missing:
                found.append(f"the residual was trained with {', '.join(missing)}, which this data lacks")
            strange = sorted(set(observations.prism.tolist()) - set(self.residual.prisms))
            if strange:
                found.append(f"the residual was not trained on prism {', '.join(strange)} and is left out there")
        return tuple(found)

    def _other_torques(self, observations: Observations) -> Iterator[str]:
        """Joints whose torque is computed where it was measured in training, or the other way round."""
        learned = self.residual.signals if self.residual is not None else ()
        used = {e.where for e in self.effects if e.family == "joint_compliance"}
        used |= {joint.name for joint in self.rig.joints if f"torque_{joint.name}_Nm" in learned}
        situation = self._situation(observations)
        for name in sorted(used) if len(observations) else ():
            before, now = name in self.coverage.torques, situation.is_torque_measured(name)
            if before and not now:
                yield (
                    f"the torque of {name} was measured in training ({name}_Nm), which this data lacks: it is computed "
                    f"from the rig file's masses, whose error is in no standard deviation"
                )
            elif now and not before:
                yield (
                    f"the torque of {name} was computed from the rig file's masses in training and is measured here "
                    f"({name}_Nm): leave the column out, or calibrate with it"
                )

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
