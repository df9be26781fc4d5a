"""A calibrated model as it predicts: its parts prepared once, and one path through them for one row or many."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import AppliedEffects, Columns, corrected
from calibration.errors import CalibrationError
from calibration.identification.samples import reading_variance
from calibration.kernels.machine import Located, Machine
from calibration.kinematics import ChainData, Linearisation
from calibration.observations import Floats, Observations
from calibration.residual.features import Extractor, Features
from calibration.torques import GravityLoads

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Executor

    from calibration.model import CalibratedModel

_PIECE = 1250  # rows that are worked on at a time


@dataclass(frozen=True)
class Prediction:
    """Positions with their uncertainty.

    Attributes:
        position_mm: (n, 3) in the station's frame, as its fixes would be: what these err by is part of it.
        sigma_mm: (n, 3) standard deviation of a fix about it: parameters, readings, timing, station, effects left out
            for want of a column, what the model lacks.
    """

    position_mm: Floats
    sigma_mm: Floats


@dataclass(frozen=True)
class Rows:
    """n observations as the kinematics take them.

    Attributes:
        data: bound, with the joints where the effects have them.
        situation: the observations as read.
        columns: what unit coefficients of the effects do.
        shift_mm: (n, 3) by what the effects move the prisms beside the joints, in the station's frame; None for
            nothing.
    """

    data: ChainData
    situation: Situation
    columns: Columns
    shift_mm: Floats | None

    def shifted(self, position_mm: Floats) -> Floats:
        """(n, 3) positions of the kinematics as the effects have them."""
        return position_mm if self.shift_mm is None else position_mm + self.shift_mm


@dataclass(frozen=True)
class Parts:
    """Positions of n rows by the whole model, and what they are made of; all in the station's frame.

    Attributes:
        position_mm: (n, 3).
        readings: (n, joints) where the effects have the joints, deg or mm.
        joint_jacobian: (n, 3, joints) by these, mm per deg or mm, without the correction's part.
        correction_mm: (n, 3) what the residual learner has added.
    """

    position_mm: Floats
    readings: Floats
    joint_jacobian: Floats
    correction_mm: Floats


class Predictor:
    """The parts of a model, prepared.

    Every method takes observations whose set-ups the model knows.

    Args:
        model: what predicts.
    """

    def __init__(self, model: CalibratedModel) -> None:
        self._model, self._chain, rig = model, model.chain, model.rig
        self._effects = AppliedEffects(model.effects, model.chain)
        self._loads = GravityLoads(model.chain, model.values)
        self._machine = Machine(model.chain, model.values, model.covariance, self._effects.joint, model.repeat_sigma_mm)
        self._reading_variance = reading_variance(rig)
        self._rate_columns = [(index, f"{name}_rate") for index, name in enumerate(rig.joint_names)]
        self._made_good = 1.0 - model.random_share(model.noise_mm**2)
        self._excess_mm2 = np.full((2, 3), model.excess_sigma_mm**2)
        if model.residual is not None:
            self._excess_mm2[1] = model.residual.excess_variance_mm2
            self._extract = Extractor(model.chain, model.values, model.residual.signals)
            self._trained = np.array([name in model.residual.prisms for name in rig.prism_names])

    def rotations(self, observations: Observations) -> Floats:
        """(n, 3, 3) from the base frame to the station's."""
        return self._rotations(self._chain.bind(observations))

    def corrected(self, observations: Observations) -> Observations:
        """The observations with the joints where the effects have them."""
        if not self._model.effects:
            return observations
        change = self._effects.change(self._effects.columns(self.situation(observations)))
        return corrected(observations, change, self._model.rig.joint_names)

    def effects_mm(self, observations: Observations) -> Floats:
        """(n, 3) positions by kinematics and effects."""
        rows = self._rows(observations)
        position_mm = rows.shifted(self._machine.locate(rows.data).position_mm)
        _refuse_infinite(position_mm)
        return position_mm

    def parts(self, observations: Observations) -> Parts:
        """The whole model without its uncertainty, part by part."""
        rows = self._rows(observations)
        located, estimate, _ = self._located(rows)
        rotation = self._rotations(rows.data)
        correction, by_joint = _turned(rotation, estimate), rotation @ located.joint_jacobian
        _refuse_infinite(located.position_mm, correction)
        return Parts(rows.shifted(located.position_mm) + correction, rows.data.readings, by_joint, correction)

    def base_mm(self, observations: Observations) -> Floats:
        """(n, 3) where the prisms are in the base frame."""
        rows = self._rows(observations)
        located, estimate, _ = self._located(rows)
        place_mm = located.prism_mm + estimate
        shift_mm = self._effects.machine_shifted_mm(rows.columns)
        if shift_mm is not None:
            place_mm += _turned(self._rotations(rows.data).transpose(0, 2, 1), shift_mm)
        _refuse_infinite(place_mm)
        return place_mm

    def predict(self, observations: Observations, executor: Executor | None = None) -> Prediction:
        """Positions and the standard deviation that a fix of them has.

        Args:
            observations: n rows.
            executor: threads among which many rows are divided; the result does not depend on it.

        Raises:
            CalibrationError: a position or its standard deviation is not a finite number.
        """
        found = self._in_pieces(observations, executor)
        _refuse_infinite(found.position_mm, found.sigma_mm)
        return found

    def _in_pieces(self, observations: Observations, executor: Executor | None) -> Prediction:
        if len(observations) <= _PIECE or self._effects.goes_by_order:
            return self._predict(observations)
        rows = np.arange(len(observations))
        pieces = [observations.select(rows[first : first + _PIECE]) for first in range(0, len(rows), _PIECE)]
        found = list((executor.map if executor is not None else map)(self._predict, pieces))
        return Prediction(
            np.concatenate([piece.position_mm for piece in found]), np.concatenate([piece.sigma_mm for piece in found])
        )

    def _predict(self, observations: Observations) -> Prediction:
        rows = self._rows(observations)
        located, of_fix, of_parameters = self._spread(rows, jacobian=self._model.residual is not None)
        estimate, weight = self._learned(rows, located)
        position_mm, sigma_mm = self._machine.learned(
            rows.data,
            rows.shifted(located.position_mm),
            estimate,
            weight,
            of_fix,
            of_parameters,
            self._by_refitted_base(rows, located),
            self._made_good,
            self._excess_mm2,
        )
        return Prediction(position_mm, sigma_mm)

    def correction(self, observations: Observations) -> tuple[Floats, Floats]:
        """(n, 3) what the residual learner adds, mm; (n, 3, 3) covariance of what the model lacks even so, mm^2.

        Both in the station's frame.
        """
        rows = self._rows(observations)
        rotation = self._rotations(rows.data)
        _, estimate, weight = self._located(rows)
        without, learned = self._excess_mm2
        excess = (1.0 - weight)[:, None] * without + weight[:, None] * learned
        return _turned(rotation, estimate), (rotation * excess[:, None, :]) @ rotation.transpose(0, 2, 1)

    def features(self, observations: Observations, signals: Sequence[str]) -> Features:
        """What a residual learner sees, effects taken into account."""
        rows = self._rows(observations)
        located = self._linearise(rows)
        residual = self._model.residual
        prepared = residual is not None and tuple(signals) == residual.signals
        extract = self._extract if prepared else Extractor(self._chain, self._model.values, signals)
        return extract(rows.data.readings, located, observations.extra)

    def covariances(self, observations: Observations) -> tuple[Floats, Floats, Floats]:
        """(n, 3) positions of stage effects; (n, 3, 3) covariance of a fix, and that by parameters and coefficients."""
        rows = self._rows(observations)
        located, of_fix, of_parameters = self._spread(rows, jacobian=False)
        return rows.shifted(located.position_mm), of_fix, of_parameters

    def linearise(self, observations: Observations) -> tuple[Linearisation, Floats]:
        """Stage effects with derivatives, and (n, 3, p + k) those by parameters and coefficients, mm per unit."""
        rows = self._rows(observations)
        located = self._linearise(rows)
        rotation = self._rotations(rows.data)
        jacobian = rotation @ located.jacobian
        by_parameters = jacobian[:, :, : len(self._chain)]
        by_joint = rotation @ located.joint_jacobian
        return Linearisation(rows.shifted(located.position_mm), by_parameters, by_joint), jacobian

    def unknown_variance(self, observations: Observations) -> Floats:
        """(n, joints) variance of the joints' values by effects left out for want of a column, deg^2 or mm^2."""
        return self._effects.unknown_variance(self.situation(observations))

    def situation(self, observations: Observations) -> Situation:
        """What effects may see of the observations."""
        return Situation(self._chain, self._model.values, observations, self._loads, self._machine)

    def _rows(self, observations: Observations) -> Rows:
        situation = self.situation(observations)
        data, columns = situation.data, self._effects.columns(situation)
        if self._model.effects:
            data = ChainData(data.readings + self._effects.change(columns), data.prism, data.setup)
        return Rows(data, situation, columns, self._effects.shifted_mm(columns))

    def _located(self, rows: Rows) -> tuple[Located, Floats, Floats]:
        """Where the kinematics have the prisms, and what the residual learner adds, as `_learned`."""
        located = self._machine.locate(rows.data) if self._model.residual is None else self._linearise(rows)
        return located, *self._learned(rows, located)

    def _linearise(self, rows: Rows) -> Located:
        return self._machine.linearise(rows.data, rows.columns.column, self._shift_in_base(rows))

    def _shift_in_base(self, rows: Rows) -> Floats | None:
        """(n, 3, k) displacements by unit coefficients in the base frame."""
        shift_mm = rows.columns.shift_mm
        return None if shift_mm is None else self._rotations(rows.data).transpose(0, 2, 1) @ shift_mm

    def _rotations(self, data: ChainData) -> Floats:
        return self._machine.rotations(data)

    def _spread(self, rows: Rows, *, jacobian: bool) -> tuple[Located, Floats, Floats]:
        observations = rows.situation.observations
        rates = np.zeros(rows.data.readings.shape)
        for index, name in self._rate_columns:
            measured = observations.extra.get(name)
            if measured is not None:
                rates[:, index] = measured
        variance = self._effects.unknown_variance(rows.situation) + self._reading_variance
        located, of_fix, of_parameters = self._machine.spread(
            rows.data,
            rows.columns.column,
            self._shift_in_base(rows),
            observations.sigma_mm,
            rates,
            variance,
            jacobian=jacobian,
        )
        if rows.shift_mm is not None:
            of_fix += self._effects.unknown_mm2(rows.situation)[:, None, None] * np.eye(3)
        return located, of_fix, of_parameters

    def _by_refitted_base(self, rows: Rows, located: Located) -> Floats:
        """(n, 3) variance by what a base's own few fixes leave uncertain of it, which no learner makes good."""
        if self._model.residual is None or self._model.base_covariance is None:
            return np.zeros((len(rows.data), 3))
        base = slice(self._chain.base_start, len(self._chain))
        jacobian = self._rotations(rows.data) @ located.jacobian[:, :, base]
        variance: Floats = ((jacobian @ self._model.base_covariance) * jacobian).sum(axis=2)
        return variance

    def _learned(self, rows: Rows, located: Located) -> tuple[Floats, Floats]:
        """(n, 3) what the residual learner adds, in the base frame, mm; (n,) how much it counts, 0 to 1."""
        residual, data = self._model.residual, rows.data
        if residual is None:
            return np.zeros((len(data), 3)), np.zeros(len(data))
        seen = self._extract(data.readings, located, rows.situation.observations.extra)
        return residual.estimate(seen, self._trained[data.prism])


def _refuse_infinite(*numbers: Floats) -> None:
    """Raise CalibrationError where one of the arrays (n, 3) of predictions has what is not a finite number."""
    for predicted in numbers:
        # One sum costs less than a look at each, and hides neither infinity nor NaN.
        if not math.isfinite(predicted.sum()):
            row = int(np.argmin(np.isfinite(predicted).all(axis=1)))
            raise CalibrationError(
                f"the prediction of row {row} (from 0) is not a finite number; look for a reading or signal of that "
                f"row that no machine can have, else calibrate again"
            )


def _turned(rotation: Floats, vector: Floats) -> Floats:
    """(n, 3) vectors (n, 3), each turned by its rotation (n, 3, 3)."""
    turned: Floats = (rotation @ vector[:, :, None])[:, :, 0]
    return turned
