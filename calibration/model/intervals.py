"""Prediction intervals of a model, counted on its own training rows as if their groups had been left out."""

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

_LARGEST_GROUP = 40  # samples: the work of a group grows with the cube of their number


def with_intervals(
    model: CalibratedModel,
    observations: Observations,
    learned: NDArray[np.bool_] | None = None,
    left_mm: Floats | None = None,
) -> CalibratedModel:
    """Give a model intervals that hold the errors of new fixes of the same kind, outliers among them.

    Args:
        model: fitted to these rows; one with a residual learner has the intervals of its stage before already.
        observations: n rows, none of them copies.
        learned: (n,) rows that the residual learner was trained on, for a model that has one.
        left_mm: (k, 3) errors on these rows of learners trained without them, in the station's frame.
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
    """Errors of a model on the fixes that its base was fitted to, each as if its group had been left out of that fit.

    Attributes:
        error_mm: (n, 3) measured minus predicted, in the station's frame.
        prediction: of the rows.
        home: intervals of the model's training.
        half: (n,) 0 or 1; groups, which are stretches of a path or cells, are wholly in one of them.
        samples: how many of the rows are independent of each other.
        has_one_setup: whether x and y point the same way in all rows.
    """

    error_mm: Floats
    prediction: Prediction
    home: StageIntervals
    half: NDArray[np.intp]
    samples: int
    has_one_setup: bool

    @classmethod
    def of(cls, model: CalibratedModel, observations: Observations) -> SetupErrors:
        """The errors of a model with a refitted base on the n rows that this was fitted to."""
        assert model.base_covariance is not None
        prediction = Predictor.of(model).predict(observations)
        error = observations.position_mm - prediction.position_mm
        base, group = slice(model.chain.base_start, len(model.chain)), _groups(observations)
        apart, samples = _left_out(model, observations, error, group, base, model.base_covariance)
        has_one_setup = len(np.unique(observations.setup)) == 1
        return cls(apart, prediction, model.intervals, group % 2, samples, has_one_setup)

    @property
    def intervals(self) -> StageIntervals:
        """Intervals that hold at these set-ups too, and are nowhere narrower than those of the training.

        What a machine does elsewhere that it did not do in its training is in these errors and nowhere else.
        """
        return self._counted(np.ones(len(self.half), dtype=np.bool_))

    def coverage(self) -> Coverage:
        """Share of the errors inside intervals that were counted on the other half of them."""
        formal_mm, weight = self.prediction.formal_mm, self.prediction.weight
        half_mm, radius_mm = np.empty_like(formal_mm), np.empty(len(formal_mm))
        for half in range(2):
            here, intervals = self.half == half, self._counted(self.half != half)
            own = None if weight is None else weight[here]
            half_mm[here] = intervals.half_mm(formal_mm[here], own)
            radius_mm[here] = intervals.radius_mm(formal_mm[here], own)
        return coverage(self.error_mm, half_mm, radius_mm)

    def _counted(self, rows: NDArray[np.bool_]) -> StageIntervals:
        """Intervals of the training, widened so that they hold the errors of some of the rows."""
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
    """Return the errors that rows would have, had the fit not seen their group; outliers it did not follow.

    Args:
        model: the model.
        observations: n rows.
        error_mm: (n, 3) of the rows.
        group: (n,) number of each row's group.
        fitted: which parameters and coefficients were.
        covariance: (f, f) of these.

    Returns:
        (n, 3) errors, mm; how many of the rows are independent of each other.
    """
    followed = np.ones(len(observations), dtype=bool)
    # The fit has not followed outliers: they are no nearer for it, nor is anything farther without them.
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
    """(n,) number of each row's stretch of a path or cell."""
    return np.asarray(np.unique(neighbour_labels(observations), return_inverse=True)[1].reshape(-1), dtype=np.intp)


def _blocks(group: NDArray[np.intp], samples: Samples) -> NDArray[np.intp]:
    """(m,) number of each sample's group, given that of its rows; in pieces where too many for one block are in it."""
    out = np.zeros(len(samples), dtype=np.intp)
    out[samples.of_row] = group
    order = np.argsort(out, kind="stable")
    first = np.unique(out[order], return_index=True)[1]
    place = np.empty(len(out), dtype=np.intp)
    place[order] = np.arange(len(out)) - np.repeat(first, np.diff(np.append(first, len(out))))
    return np.asarray(out * len(out) + place // _LARGEST_GROUP, dtype=np.intp)
