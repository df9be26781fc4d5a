"""Prediction intervals of a model, counted on its own training rows as if each had been left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.samples import averaged, left_out_errors
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Floats, Observations
from calibration.residual.conformal import conformal_intervals


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
    )
    error[~outlier] += (apart - mean)[samples.of_row]
    return replace(model, intervals=conformal_intervals(error, prediction.sigma_mm, len(samples)))
