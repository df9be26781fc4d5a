"""Prediction with a calibrated model; its parts are prepared once, and the same code serves one row or many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from calibration.effects.columns import EffectColumns
from calibration.effects.context import EffectContext
from calibration.effects.fitted import AppliedEffects, corrected
from calibration.errors import CalibrationError, UnsafeError
from calibration.identification.noise import reading_variance
from calibration.kinematics import fix_loops
from calibration.kinematics.chain import ChainData, Linearisation
from calibration.kinematics.compiled_chain import CompiledChain, Located
from calibration.kinematics.torques import GravityModel
from calibration.model.model import CalibratedModel, Outlier
from calibration.observations import Floats, Observations
from calibration.residual.conformal import NORMAL, Coverage, coverage
from calibration.residual.features import Extractor, Features

OUTLIER_SIGMA = 5.0

_PIECE = 1250  # rows that are computed at a time


@dataclass(frozen=True)
class Prediction:
    """Predicted positions with their uncertainty.

    Attributes:
        position_mm: (n, 3) positions in the station's frame as the station would measure them, including systematic
            errors of fixes.
        formal_mm: (n, 3) standard deviation of a fix about its prediction, propagated from parameters, readings,
            timing, station, effects that are left out because a column is missing, and the error of the model.
        sigma_mm: (n, 3) the same, calibrated on rows left out of the fit so that 90 % of fixes lie within 1.645 times
            it.
        radius_mm: (n,) 3-D distance within which a fix lies with 90 % probability.
        weight: (n,) weight of the residual learner in each row, 0 to 1; None for a model without a learner.
    """

    position_mm: Floats
    formal_mm: Floats
    sigma_mm: Floats
    radius_mm: Floats
    weight: Floats | None

    @property
    def half_mm(self) -> Floats:
        """(n, 3) half widths of the 90 % intervals of a fix along each axis."""
        return NORMAL * self.sigma_mm

    def coverage(self, error_mm: Floats) -> Coverage:
        """Return the share of errors (n, 3) that are inside their 90 % intervals."""
        return coverage(error_mm, self.half_mm, self.radius_mm)


@dataclass(frozen=True)
class _Rows:
    """n observations prepared for the kinematics.

    Attributes:
        data: readings as corrected by the effects, prisms and set-ups.
        context: the observations as read.
        columns: effects per unit of their coefficients.
        shift_mm: (n, 3) displacements of the prisms by effects that do not act through joints, in the station's frame.
    """

    data: ChainData
    context: EffectContext
    columns: EffectColumns
    shift_mm: Floats


@dataclass(frozen=True)
class PositionParts:
    """Positions of n rows predicted by the whole model, and their parts; all in the station's frame.

    Attributes:
        position_mm: (n, 3) positions.
        readings: (n, joints) joint values as corrected by the effects, deg or mm.
        joint_jacobian: (n, 3, joints) derivatives by these, mm per deg or mm, without those of the correction.
        correction_mm: (n, 3) part of the positions due to the residual learner.
    """

    position_mm: Floats
    readings: Floats
    joint_jacobian: Floats
    correction_mm: Floats


class Predictor:
    """Predictions of a model for observations, with the model's parts prepared once.

    `Predictor.of(model)` prepares a model at the first call and keeps the result with it. Unless stated otherwise,
    methods raise UnsafeError for observations of a set-up that the model does not know (as `check_setups`), and
    CalibrationError if a position or its standard deviation is not a finite number.

    Args:
        model: the model to predict with.
    """

    def __init__(self, model: CalibratedModel) -> None:
        self._model, self._chain, rig = model, model.chain, model.rig
        self._effects = AppliedEffects(model.effects, model.chain)
        self._loads = GravityModel(model.chain, model.values)
        self._machine = CompiledChain(
            model.chain, model.values, model.covariance, self._effects.joint, model.repeat_sigma_mm
        )
        self._reading_variance = reading_variance(rig)
        self._rate_columns = [(index, f"{name}_rate") for index, name in enumerate(rig.joint_names)]
        self._made_good = 1.0 - self._random_share(model.noise_mm**2)
        self._excess_mm2 = np.full((2, 3), model.excess_sigma_mm**2)
        if model.residual is not None:
            self._excess_mm2[1] = model.residual.excess_variance_mm2
            self._extract = Extractor(model.chain, model.values, model.residual.signals)
            self._trained = np.array([name in model.residual.prisms for name in rig.prism_names])

    @classmethod
    def of(cls, model: CalibratedModel) -> Predictor:
        """Return the model's predictor, prepared once."""
        found: Predictor | None = model.prepared.get(cls)
        if found is None:
            found = model.prepared[cls] = cls(model)
        return found

    def predict(self, observations: Observations, executor: Executor | None = None) -> Prediction:
        """Predict positions and the standard deviation of a fix about each.

        Args:
            observations: n rows; their positions, if any, are ignored.
            executor: threads among which many rows are divided; the result does not depend on it.
        """
        if len(observations) <= _PIECE or self._effects.depends_on_order:
            return self._predict(observations)
        rows = np.arange(len(observations))
        pieces = [observations.select(rows[first : first + _PIECE]) for first in range(0, len(rows), _PIECE)]
        found = list((executor.map if executor is not None else map)(self._predict, pieces))
        return Prediction(
            np.concatenate([piece.position_mm for piece in found]),
            np.concatenate([piece.formal_mm for piece in found]),
            np.concatenate([piece.sigma_mm for piece in found]),
            np.concatenate([piece.radius_mm for piece in found]),
            None if self._model.residual is None else np.concatenate([piece.weight for piece in found]),
        )

    def nominal_mm(self, observations: Observations) -> Floats:
        """Return (n, 3) positions predicted by the nominal rig, in the station's frame, mm."""
        return self._by_kinematics(self._model.nominal_values, observations)

    def geometric_mm(self, observations: Observations) -> Floats:
        """Return (n, 3) positions by the kinematics identified without effects, in the station's frame, mm."""
        return self._by_kinematics(self._model.geometric_values, observations)

    def effects_mm(self, observations: Observations) -> Floats:
        """Return (n, 3) positions by kinematics and effects, in the station's frame, mm."""
        rows = self._rows(observations)
        position_mm = self._machine.locate(rows.data).position_mm + rows.shift_mm
        _refuse_infinite(observations, position_mm)
        return position_mm

    def parts(self, observations: Observations) -> PositionParts:
        """Predict positions without their uncertainty, and return them with their parts."""
        rows = self._rows(observations)
        located, estimate, _ = self._located(rows)
        rotation = self._machine.rotations(rows.data)
        correction, by_joint = _turned(rotation, estimate), rotation @ located.joint_jacobian
        _refuse_infinite(observations, located.position_mm, correction)
        return PositionParts(located.position_mm + rows.shift_mm + correction, rows.data.readings, by_joint, correction)

    def base_mm(self, observations: Observations) -> Floats:
        """Return (n, 3) positions of the prisms in the base frame predicted by the whole model, mm.

        Effects that change only fixes (those of station, prisms and clocks) or that move the base are excluded.
        """
        rows = self._rows(observations)
        located, estimate, _ = self._located(rows)
        place_mm = located.prism_mm + estimate
        if rows.columns.shift_mm is not None:
            shift_mm = rows.columns.shifted_mm(self._effects.machine_values)
            place_mm += _turned(self._machine.rotations(rows.data).transpose(0, 2, 1), shift_mm)
        _refuse_infinite(observations, place_mm)
        return place_mm

    def to_station(self, observations: Observations, vector_mm: Floats) -> Floats:
        """Rotate (n, 3) vectors from the base frame to the station's frame."""
        return _turned(self._machine.rotations(self._chain.bind(observations)), vector_mm)

    def to_base(self, observations: Observations, vector_mm: Floats) -> Floats:
        """Rotate (n, 3) vectors from the station's frame to the base frame."""
        return _turned(self._machine.rotations(self._chain.bind(observations)).transpose(0, 2, 1), vector_mm)

    def corrected(self, observations: Observations) -> Observations:
        """Return the observations with their joint readings corrected by the effects."""
        if not self._model.effects:
            return observations
        columns = self._effects.columns(self.context(observations))
        change = columns.change(self._effects.values, len(self._model.rig.joints))
        return corrected(observations, change, self._model.rig.joint_names)

    def correction(self, observations: Observations) -> tuple[Floats, Floats]:
        """Compute the correction by the residual learner, zero for prisms on which it was not trained.

        Returns:
            (n, 3) correction, mm, and (n, 3, 3) covariance of the remaining errors of the model, mm^2, both in the
            station's frame.
        """
        rows = self._rows(observations)
        rotation = self._machine.rotations(rows.data)
        _, estimate, weight = self._located(rows)
        without, learned = self._excess_mm2
        excess = (1.0 - weight)[:, None] * without + weight[:, None] * learned
        return _turned(rotation, estimate), (rotation * excess[:, None, :]) @ rotation.transpose(0, 2, 1)

    def features(self, observations: Observations, signals: Sequence[str]) -> Features:
        """Compute the features of a residual learner with these signal columns, after correction by the effects."""
        rows = self._rows(observations)
        located = self._linearise(rows)
        residual = self._model.residual
        prepared = residual is not None and tuple(signals) == residual.signals
        extract = self._extract if prepared else Extractor(self._chain, self._model.values, signals)
        return extract(rows.data.readings, located, observations.extra)

    def linearise(self, observations: Observations) -> Linearisation:
        """Compute positions by kinematics and effects, with derivatives by parameters, coefficients and readings."""
        rows = self._rows(observations)
        located = self._linearise(rows)
        rotation = self._machine.rotations(rows.data)
        return Linearisation(
            located.position_mm + rows.shift_mm, rotation @ located.jacobian, rotation @ located.joint_jacobian
        )

    def deviations(self, observations: Observations) -> Floats:
        """Return the (n,) errors of kinematics and effects in sigma (Mahalanobis length).

        Raises:
            CalibrationError: the uncertainty of a position is too large for any machine.
        """
        position, known, parameters = self._covariances(observations)
        error = observations.position_mm - position
        try:
            factor = np.linalg.cholesky(known + parameters + self._model.excess_sigma_mm**2 * np.eye(3))
        except np.linalg.LinAlgError as failure:
            raise CalibrationError(
                "the model's uncertainty of a position is so large that rounding hides its noise; calibrate again"
            ) from failure
        whitened = np.linalg.solve(factor, error[:, :, None])[:, :, 0]
        return np.asarray(np.linalg.norm(whitened, axis=1), dtype=np.float64)

    def find_outliers(self, observations: Observations) -> tuple[Outlier, ...]:
        """Return the fixes farther from kinematics and effects than noise and parameters explain."""
        size = self.deviations(observations)
        return tuple(Outlier(int(row), float(size[row])) for row in np.flatnonzero(size > OUTLIER_SIGMA))

    def unexplained_mm2(self, observations: Observations, variance_mm2: Floats) -> Floats:
        """Return the mean squared errors of a learner minus the known noise.

        As the kinematics were fitted to the training rows, their errors are smaller than those of new rows by the
        share of the parameters. Predictions add that share.

        Args:
            observations: the training rows.
            variance_mm2: (3,) mean squared errors on these, along the axes of the base frame.

        Returns:
            (3,) variances along the same axes, not negative.
        """
        _, known, parameters = self._covariances(observations)
        rotation = self._machine.rotations(self._chain.bind(observations))
        parameters *= self._random_share(float(variance_mm2.sum()))
        in_base = rotation.transpose(0, 2, 1) @ (known - parameters) @ rotation
        left: Floats = np.maximum(variance_mm2 - np.diagonal(in_base, axis1=1, axis2=2).mean(axis=0), 0.0)
        return left

    def unknown_variance(self, observations: Observations) -> Floats:
        """Return the (n, joints) variance of joint values due to effects that lack a column, deg^2 or mm^2."""
        return self._effects.unknown_variance(self.context(observations))

    def context(self, observations: Observations) -> EffectContext:
        """Return the observations as a context for effects; they may be of any set-up."""
        return EffectContext(self._chain, self._model.values, observations, self._loads, self._machine)

    def _by_kinematics(self, values: Floats, observations: Observations) -> Floats:
        """Return (n, 3) positions by parameters (p,) without effects."""
        check_setups(self._model, observations)
        return CompiledChain(self._chain, values).locate(self._chain.bind(observations)).position_mm

    def _random_share(self, variance_mm2: float) -> float:
        """Return the share of the parameters' covariance that is due to noise and not corrected by a learner.

        The learner is trained on the residuals of these parameters, so it corrects their errors from systematic causes.
        """
        return min(1.0, variance_mm2 / max(self._model.effects_noise_mm**2, 1e-12))

    def _predict(self, observations: Observations) -> Prediction:
        rows = self._rows(observations)
        located, of_fix, of_parameters = self._spread(rows, jacobian=self._model.residual is not None)
        estimate, weight = self._learned(rows, located)
        position_mm, formal_mm = np.empty((len(rows.data), 3)), np.empty((len(rows.data), 3))
        is_finite = fix_loops.add_learned(
            rows.data.setup,
            self._machine.bases,
            np.ascontiguousarray(located.position_mm + rows.shift_mm),
            np.ascontiguousarray(estimate),
            weight,
            of_fix,
            of_parameters,
            self._by_refitted_base(rows, located),
            self._made_good,
            self._excess_mm2,
            position_mm,
            formal_mm,
        )
        if not is_finite:
            _refuse_infinite(observations, position_mm, formal_mm)
        intervals, used = self._model.intervals, None if self._model.residual is None else weight
        return Prediction(
            position_mm,
            formal_mm,
            intervals.half_mm(formal_mm, used) / NORMAL,
            intervals.radius_mm(formal_mm, used),
            used,
        )

    def _covariances(self, observations: Observations) -> tuple[Floats, Floats, Floats]:
        """Return positions (n, 3) at stage effects, and covariances (n, 3, 3) of a fix and of the parameters' part."""
        rows = self._rows(observations)
        located, of_fix, of_parameters = self._spread(rows, jacobian=False)
        return located.position_mm + rows.shift_mm, of_fix, of_parameters

    def _rows(self, observations: Observations) -> _Rows:
        check_setups(self._model, observations)
        context = self.context(observations)
        columns = self._effects.columns(context)
        data, shift_mm = columns.apply(context.data, self._effects.values)
        return _Rows(data, context, columns, shift_mm)

    def _located(self, rows: _Rows) -> tuple[Located, Floats, Floats]:
        """Return positions by the kinematics, and the residual learner's estimate and weight as `_learned`."""
        located = self._machine.locate(rows.data) if self._model.residual is None else self._linearise(rows)
        return located, *self._learned(rows, located)

    def _linearise(self, rows: _Rows) -> Located:
        return self._machine.linearise(rows.data, rows.columns.column, self._shift_in_base(rows))

    def _shift_in_base(self, rows: _Rows) -> Floats | None:
        """Return (n, 3, k) displacements by unit coefficients in the base frame."""
        shift_mm = rows.columns.shift_mm
        return None if shift_mm is None else self._machine.rotations(rows.data).transpose(0, 2, 1) @ shift_mm

    def _spread(self, rows: _Rows, *, jacobian: bool) -> tuple[Located, Floats, Floats]:
        observations = rows.context.observations
        rates = np.zeros(rows.data.readings.shape)
        for index, name in self._rate_columns:
            measured = observations.extra.get(name)
            if measured is not None:
                rates[:, index] = measured
        variance = self._effects.unknown_variance(rows.context) + self._reading_variance
        located, of_fix, of_parameters = self._machine.spread(
            rows.data,
            rows.columns.column,
            self._shift_in_base(rows),
            observations.sigma_mm,
            rates,
            variance,
            jacobian=jacobian,
        )
        if rows.columns.shift_mm is not None:
            of_fix += self._effects.unknown_mm2(rows.context)[:, None, None] * np.eye(3)
        return located, of_fix, of_parameters

    def _by_refitted_base(self, rows: _Rows, located: Located) -> Floats:
        """Return the (n, 3) variance due to a refitted base, which is known from few fixes; no learner corrects it."""
        if self._model.residual is None or self._model.base_covariance is None:
            return np.zeros((len(rows.data), 3))
        base = slice(self._chain.base_start, len(self._chain))
        jacobian = self._machine.rotations(rows.data) @ located.jacobian[:, :, base]
        variance: Floats = ((jacobian @ self._model.base_covariance) * jacobian).sum(axis=2)
        return variance

    def _learned(self, rows: _Rows, located: Located) -> tuple[Floats, Floats]:
        """Return the (n, 3) estimate of the residual learner in the base frame, mm, and its (n,) weight, 0 to 1."""
        residual, data = self._model.residual, rows.data
        if residual is None:
            return np.zeros((len(data), 3)), np.zeros(len(data))
        seen = self._extract(data.readings, located, rows.context.observations.extra)
        return residual.estimate(seen, self._trained[data.prism])


def check_setups(model: CalibratedModel, observations: Observations) -> None:
    """Raise UnsafeError if the observations come from a set-up that the model does not know."""
    unknown = sorted(set(observations.setup.tolist()) - set(model.placements))
    if unknown:
        known = ", ".join(repr(s) for s in sorted(model.placements))
        blank = "" if unknown[0] else " (no setup in the row)"
        raise UnsafeError(
            f"set-up {unknown[0]!r}{blank} is unknown to the model (known: {known}); its base transform would be a "
            "guess. `rigcal evaluate --refit-base` fits it on fixes of that set-up"
        )


def _refuse_infinite(observations: Observations, *numbers: Floats) -> None:
    """Raise CalibrationError if one of the arrays (n, 3) of predictions is not finite."""
    for predicted in numbers:
        # One sum costs less than checking each element, and shows both infinity and NaN.
        if not math.isfinite(predicted.sum()):
            row = int(np.argmin(np.isfinite(predicted).all(axis=1)))
            raise CalibrationError(
                f"the prediction of {observations.row_name(row)} is not a finite number; check that row for an "
                f"impossible reading or signal, else calibrate again"
            )


def _turned(rotation: Floats, vector: Floats) -> Floats:
    """Return vectors (n, 3), each turned by its rotation (n, 3, 3)."""
    turned: Floats = (rotation @ vector[:, :, None])[:, :, 0]
    return turned
