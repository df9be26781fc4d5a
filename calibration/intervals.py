"""Intervals of a model, counted on its own training rows as if each had been left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.identification.left_out import left_out_errors
from calibration.identification.samples import averaged
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.residual.conformal import conformal_intervals


def with_intervals(
    model: CalibratedModel,
    observations: Observations,
    learned: NDArray[np.bool_] | None = None,
    left_mm: Floats | None = None,
) -> CalibratedModel:
    """The model with intervals that hold what new fixes of the same kind, outliers among them, are off.

    Args:
        model: fitted to these rows.
        observations: n rows, none of them copies.
        learned: (n,) rows that the residual learner was trained on, for a model that has one.
        left_mm: (k, 3) what such learners leave of these rows that were trained without them, in the station's frame.
    """
    prediction = model.predict(observations)
    error = observations.position_mm - prediction.position_mm
    if learned is not None and left_mm is not None:
        error[learned] = left_mm
    outlier = np.zeros(len(observations), dtype=bool)
    outlier[[o.row for o in model.find_outliers(observations)]] = True
    # The fit has not followed outliers: they are no nearer for it, nor is anything farther without them.
    followed = observations.select(~outlier)
    lin, jacobian = model.linearise(followed)
    samples = averaged(model.chain, model.corrected(followed))
    mean = samples.average(error[~outlier])
    apart = left_out_errors(
        model.rig,
        samples,
        mean,
        samples.average(jacobian),
        samples.average(lin.joint_jacobian),
        model.covariance,
        model.excess_sigma_mm**2,
    )
    error[~outlier] += (apart - mean)[samples.of_row]
    return replace(model, intervals=conformal_intervals(error, prediction.sigma_mm, len(samples)))
