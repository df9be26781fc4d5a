"""A calibrated model at another set-up: the rigid base transform fitted anew, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.identification.refinement import Fit, refine
from calibration.identification.samples import Samples, averaged, reading_covariance
from calibration.identification.start import rough_start
from calibration.kinematics import Chain, Placement
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations


def with_refitted_base(model: CalibratedModel, observations: Observations) -> CalibratedModel:
    """The model at the set-ups of these observations.

    Raises:
        DataError: a prism that the rig lacks.
        UnsafeError: fewer than three fixes of a set-up, all on a line, or mirrored.
    """
    setups = sorted(set(observations.setup.tolist()))
    blank = Chain(model.rig, {setup: Placement.identity() for setup in setups})
    samples = averaged(blank, observations)
    body = model.chain.base_start

    def extended(values: Floats) -> Floats:
        return np.concatenate([values[:body], np.zeros(6 * len(setups))])

    start = rough_start(blank, samples, extended(model.values), offsets=False)
    chain = Chain(model.rig, start.placements)
    free = np.arange(len(chain)) >= body
    fit = refine(chain, samples, extended(model.values), free=free, excess_variance=model.excess_sigma_mm**2)
    nominal = refine(chain, samples, extended(model.nominal_values), free=free)
    return replace(
        model,
        placements=start.placements,
        values=fit.x,
        covariance=_covariance(chain, samples, fit, model.covariance[:body, :body]),
        nominal_values=nominal.x,
    )


def _covariance(chain: Chain, samples: Samples, fit: Fit, body_covariance: Floats) -> Floats:
    """(p, p) covariance when the base follows whatever the body's parameters are.

    Much of the body's uncertainty is of directions that a base transform undoes; the new base undoes them as the old
    one did, so its estimate is correlated with the body's parameters: d base / d body = -H_bb^-1 H_bk.
    """
    body = len(body_covariance)
    lin = chain.linearise(fit.x, samples.data)
    known = samples.station_covariance + reading_covariance(chain.rig, lin.joint_jacobian, samples.rates)
    inverse = np.linalg.inv(known + fit.excess_variance * np.eye(3)) * fit.weight[:, None, None]
    weighted = (inverse @ lin.jacobian[:, :, :body]).reshape(-1, body)
    base_jacobian = lin.jacobian[:, :, body:].reshape(len(weighted), -1)
    own = fit.covariance[body:, body:]
    follows = -own @ base_jacobian.T @ weighted
    covariance = np.zeros_like(fit.covariance)
    covariance[:body, :body] = body_covariance
    covariance[body:, :body] = follows @ body_covariance
    covariance[:body, body:] = covariance[body:, :body].T
    covariance[body:, body:] = own + follows @ body_covariance @ follows.T
    return covariance
