"""Prediction intervals of a model, counted on its own training rows as if their groups had been left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.samples import Samples, averaged, left_out_errors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.residual.conformal import Coverage, Intervals, conformal_intervals
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
        model: fitted to these rows.
        observations: n rows, none of them copies.
        learned: (n,) rows that the residual learner was trained on, for a model that has one.
        left_mm: (k, 3) errors on these rows of learners trained without them, in the station's frame.
    """
    prediction = Predictor.of(model).predict(observations)
    error = observations.position_mm - prediction.position_mm
    if learned is not None and left_mm is not None:
        error[learned] = left_mm
    samples = _leave_out(model, observations, error, slice(None), model.covariance)
    return replace(model, intervals=conformal_intervals(error, prediction.sigma_mm, samples))


@dataclass(frozen=True)
class SetupErrors:
    """Errors of a model on the fixes that its base was fitted to, each as if its group had been left out of that fit.

    Attributes:
        error_mm: (n, 3) measured minus predicted, in the station's frame.
        sigma_mm: (n, 3) standard deviations that the model predicts.
        half: (n,) 0 or 1; groups, which are stretches of a path or cells, are wholly in one of them.
        samples: how many of the rows are independent of each other.
        has_one_setup: whether x and y point the same way in all rows.
    """

    error_mm: Floats
    sigma_mm: Floats
    half: NDArray[np.intp]
    samples: int
    has_one_setup: bool

    @classmethod
    def of(cls, model: CalibratedModel, observations: Observations) -> SetupErrors:
        """The errors of a model with a refitted base on the n rows that this was fitted to."""
        assert model.base_covariance is not None
        prediction = Predictor.of(model).predict(observations)
        error = observations.position_mm - prediction.position_mm
        base = slice(model.chain.base_start, len(model.chain))
        samples = _leave_out(model, observations, error, base, model.base_covariance)
        group = np.unique(neighbour_labels(observations), return_inverse=True)[1].reshape(-1)
        half = np.asarray(group % 2, dtype=np.intp)
        return cls(error, prediction.sigma_mm, half, samples, len(np.unique(observations.setup)) == 1)

    def intervals(self, home: Intervals) -> Intervals:
        """Intervals that hold at these set-ups what those of the training do at home, and are not narrower than they.

        What a machine does elsewhere that it did not do in its training is in these errors and nowhere else.
        """
        return home.or_wider(self._counted(np.ones(len(self.half), dtype=np.bool_)))

    def coverage(self, home: Intervals) -> Coverage:
        """Share of the errors inside intervals that were counted on the other half of them."""
        held, total = np.zeros(4), 0
        for half in range(2):
            here, there = self.half == half, self.half != half
            if here.any():
                intervals = home.or_wider(self._counted(there)) if there.any() else home
                share = intervals.coverage(self.error_mm[here], self.sigma_mm[here])
                held += int(here.sum()) * np.array([*share.axes, share.radius])
                total += int(here.sum())
        x, y, z, radius = (held / total).tolist()
        return Coverage((x, y, z), radius)

    def _counted(self, rows: NDArray[np.bool_]) -> Intervals:
        """Intervals that hold the errors of some of the rows."""
        independent = max(1, round(self.samples * float(rows.mean())))
        counted = conformal_intervals(self.error_mm[rows], self.sigma_mm[rows], independent)
        return counted if self.has_one_setup else counted.at_other_setups()


def _leave_out(
    model: CalibratedModel, observations: Observations, error_mm: Floats, fitted: slice, covariance: Floats
) -> int:
    """Make errors (n, 3) those that rows would have, had the fit not seen their group; outliers it did not follow.

    Args:
        model: the model.
        observations: n rows.
        error_mm: of the rows; changed in place.
        fitted: which parameters and coefficients were.
        covariance: (f, f) of these.

    Returns:
        how many of the rows are independent of each other.
    """
    outlier = np.zeros(len(observations), dtype=bool)
    outlier[[o.row for o in Predictor.of(model).find_outliers(observations)]] = True
    # The fit has not followed outliers: they are no nearer for it, nor is anything farther without them.
    followed = observations.select(~outlier)
    lin = Predictor.of(model).linearise(followed)
    samples = averaged(model.chain, Predictor.of(model).corrected(followed))
    mean = samples.average(error_mm[~outlier])
    apart = left_out_errors(
        model.rig,
        samples,
        mean,
        samples.average(lin.jacobian[:, :, fitted]),
        samples.average(lin.joint_jacobian),
        covariance,
        model.excess_sigma_mm**2,
        _groups(followed, samples),
    )
    error_mm[~outlier] += (apart - mean)[samples.of_row]
    return len(samples)


def _groups(observations: Observations, samples: Samples) -> NDArray[np.intp]:
    """(m,) number of each sample's stretch of a path or cell; in pieces where too many for one block are in it."""
    group = np.unique(neighbour_labels(observations), return_inverse=True)[1].reshape(-1)
    out = np.zeros(len(samples), dtype=np.intp)
    out[samples.of_row] = group
    order = np.argsort(out, kind="stable")
    first = np.unique(out[order], return_index=True)[1]
    place = np.empty(len(out), dtype=np.intp)
    place[order] = np.arange(len(out)) - np.repeat(first, np.diff(np.append(first, len(out))))
    return np.asarray(out * len(out) + place // _LARGEST_GROUP, dtype=np.intp)
