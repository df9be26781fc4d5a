"""Prediction intervals of a model, counted on its own training rows as if their groups had been left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.samples import Samples, averaged, left_out_errors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.residual.conformal import conformal_intervals
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
    outlier = np.zeros(len(observations), dtype=bool)
    outlier[[o.row for o in Predictor.of(model).find_outliers(observations)]] = True
    # The fit has not followed outliers: they are no nearer for it, nor is anything farther without them.
    followed = observations.select(~outlier)
    lin = Predictor.of(model).linearise(followed)
    samples = averaged(model.chain, Predictor.of(model).corrected(followed))
    mean = samples.average(error[~outlier])
    apart = left_out_errors(
        model.rig,
        samples,
        mean,
        samples.average(lin.jacobian),
        samples.average(lin.joint_jacobian),
        model.covariance,
        model.excess_sigma_mm**2,
        _groups(followed, samples),
    )
    error[~outlier] += (apart - mean)[samples.of_row]
    return replace(model, intervals=conformal_intervals(error, prediction.sigma_mm, len(samples)))


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
