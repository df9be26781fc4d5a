"""Prediction intervals of a model, calibrated on its training rows as if their groups had been left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.samples import Samples, averaged, left_out_errors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Prediction, Predictor
from calibration.observations import Floats, Observations
from calibration.residual.conformal import Coverage, StageIntervals, conformal_intervals, coverage
from calibration.residual.folds import neighbour_labels

_LARGEST_GROUP = 40  # samples; the work for a group is proportional to the cube of their number


def with_intervals(
    model: CalibratedModel,
    observations: Observations,
    learned: NDArray[np.bool_] | None = None,
    left_mm: Floats | None = None,
) -> CalibratedModel:
    """Return a model with intervals that contain 90 % of the errors of similar new fixes, including outliers.

    Args:
        model: fitted to these rows; a model with a residual learner must already have intervals of stage effects.
        observations: n rows without copies.
        learned: (n,) mask of the k rows on which the residual learner was trained, for a model that has one.
        left_mm: (k, 3) out-of-fold errors of the learner on these rows, in the station's frame.
    """
    prediction = Predictor.of(model).predict(observations)
    error = observations.position_mm - prediction.position_mm
    if learned is not None and left_mm is not None:
        error[learned] = left_mm
    apart, samples = _left_out(model, observations, error, _groups(observations), slice(None), model.covariance)
    counted = conformal_intervals(apart, prediction.formal_mm, samples)
    before = counted if model.residual is None else model.intervals.effects
    return replace(model, intervals=StageIntervals(counted, before))


@dataclass(frozen=True)
class SetupErrors:
    """Errors of a model on the fixes to which its base was fitted, each as if its group had been left out of that fit.

    Attributes:
        error_mm: (n, 3) measured minus predicted, in the station's frame.
        prediction: prediction for the rows.
        home: intervals from the model's training.
        half: (n,) 0 or 1; all rows of a group (stretch of a path or cell) have the same.
        samples: number of mutually independent rows.
        has_one_setup: whether all rows are from one set-up, where x and y keep their directions.
    """

    error_mm: Floats
    prediction: Prediction
    home: StageIntervals
    half: NDArray[np.intp]
    samples: int
    has_one_setup: bool

    @classmethod
    def of(cls, model: CalibratedModel, observations: Observations) -> SetupErrors:
        """Compute the errors of a model with a refitted base on the n rows to which the base was fitted."""
        assert model.base_covariance is not None
        prediction = Predictor.of(model).predict(observations)
        error = observations.position_mm - prediction.position_mm
        base, group = slice(model.chain.base_start, len(model.chain)), _groups(observations)
        apart, samples = _left_out(model, observations, error, group, base, model.base_covariance)
        has_one_setup = len(np.unique(observations.setup)) == 1
        return cls(apart, prediction, model.intervals, group % 2, samples, has_one_setup)

    @property
    def intervals(self) -> StageIntervals:
        """Intervals that are also valid at these set-ups, and never narrower than those from the training.

        Only these errors show behaviour of the machine at other set-ups that did not occur in its training.
        """
        return self._counted(np.ones(len(self.half), dtype=np.bool_))

    def coverage(self) -> Coverage:
        """Return the share of errors inside intervals that were calibrated on the other half of the rows."""
        formal_mm, weight = self.prediction.formal_mm, self.prediction.weight
        half_mm, radius_mm = np.empty_like(formal_mm), np.empty(len(formal_mm))
        for half in range(2):
            here, intervals = self.half == half, self._counted(self.half != half)
            own = None if weight is None else weight[here]
            half_mm[here] = intervals.half_mm(formal_mm[here], own)
            radius_mm[here] = intervals.radius_mm(formal_mm[here], own)
        return coverage(self.error_mm, half_mm, radius_mm)

    def _counted(self, rows: NDArray[np.bool_]) -> StageIntervals:
        """Return the intervals from the training, widened to contain 90 % of the errors of some of the rows."""
        if not rows.any():
            return self.home
        independent = max(1, round(self.samples * float(rows.mean())))
        counted = conformal_intervals(self.error_mm[rows], self.prediction.formal_mm[rows], independent)
        return self.home.or_wider(counted if self.has_one_setup else counted.at_other_setups())


def _left_out(
    model: CalibratedModel,
    observations: Observations,
    error_mm: Floats,
    group: NDArray[np.intp],
    fitted: slice,
    covariance: Floats,
) -> tuple[Floats, int]:
    """Return the errors that rows would have if their group had been left out of the fit.

    Args:
        model: the model.
        observations: n rows.
        error_mm: (n, 3) errors of the rows.
        group: (n,) number of each row's group.
        fitted: the f parameters and coefficients that were fitted.
        covariance: (f, f) covariance of these.

    Returns:
        (n, 3) errors, mm; and the number of mutually independent rows.
    """
    followed = np.ones(len(observations), dtype=bool)
    # The fit did not follow outliers, so leaving them out changes neither their own error nor those of others.
    followed[[o.row for o in Predictor.of(model).find_outliers(observations)]] = False
    rows = observations.select(followed)
    lin = Predictor.of(model).linearise(rows)
    samples = averaged(model.chain, Predictor.of(model).corrected(rows))
    mean = samples.average(error_mm[followed])
    apart = left_out_errors(
        model.rig,
        samples,
        mean,
        samples.average(lin.jacobian[:, :, fitted]),
        samples.average(lin.joint_jacobian),
        covariance,
        model.excess_sigma_mm**2,
        _blocks(group[followed], samples),
    )
    error_mm = error_mm.copy()
    error_mm[followed] += (apart - mean)[samples.of_row]
    return error_mm, len(samples)


def _groups(observations: Observations) -> NDArray[np.intp]:
    """Return the (n,) number of each row's stretch of a path or cell."""
    return np.asarray(np.unique(neighbour_labels(observations), return_inverse=True)[1].reshape(-1), dtype=np.intp)


def _blocks(group: NDArray[np.intp], samples: Samples) -> NDArray[np.intp]:
    """Return the (m,) group number of each sample from those of its rows; large groups are divided into blocks."""
    out = np.zeros(len(samples), dtype=np.intp)
    out[samples.of_row] = group
    order = np.argsort(out, kind="stable")
    first = np.unique(out[order], return_index=True)[1]
    place = np.empty(len(out), dtype=np.intp)
    place[order] = np.arange(len(out)) - np.repeat(first, np.diff(np.append(first, len(out))))
    return np.asarray(out * len(out) + place // _LARGEST_GROUP, dtype=np.intp)
