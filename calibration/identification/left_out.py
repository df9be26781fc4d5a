"""The errors that the samples of a fit would have, had it not seen their standstill.

A fit follows each of its samples a little. In the fit linearised where it came to rest, sample errors e of a standstill
become V (V - J C J')^-1 e when it is left out (leave-one-out residuals, Cook & Weisberg 1982, extended to blocks and a
prior), with their noise V, their derivatives J and the posterior covariance C.
"""

from __future__ import annotations

import numpy as np

from calibration.identification.samples import Samples
from calibration.observations import Floats
from calibration.rig import Rig

_GREATEST_LEVERAGE = 0.95  # beyond it the linearisation says nothing any more


def left_out_errors(
    rig: Rig,
    samples: Samples,
    error_mm: Floats,
    jacobian: Floats,
    joint_jacobian: Floats,
    covariance: Floats,
    excess_variance: float,
) -> Floats:
    """Errors without the fit's help.

    Args:
        rig: gives the random errors of readings and of the fix's instant.
        samples: m rows that the fit saw.
        error_mm: (m, 3) errors of the fit, or what is left of them.
        jacobian: (m, 3, p) by everything that was fitted.
        joint_jacobian: (m, 3, joints) mm per deg or mm.
        covariance: (p, p) posterior.
        excess_variance: mm^2 per axis that the samples scatter beyond station and readings.

    Returns:
        (m, 3), mm.
    """
    own = samples.own_covariance(rig, joint_jacobian) + excess_variance * np.eye(3)
    by_reading = joint_jacobian * np.sqrt(samples.shared_variance(rig))
    out = np.empty_like(error_mm)
    standstill = np.arange(len(samples)) if samples.standstill is None else samples.standstill
    order = np.argsort(standstill, kind="stable")
    first, size = np.unique(standstill[order], return_index=True, return_counts=True)[1:]
    for k in np.unique(size):
        rows = order[first[size == k][:, None] + np.arange(k)]  # (blocks, k)
        flat = (len(rows), 3 * k, -1)
        shared = by_reading[rows].reshape(flat)
        noise = shared @ shared.transpose(0, 2, 1)
        for i in range(k):
            noise[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += own[rows[:, i]]
        factor = np.linalg.cholesky(noise)
        whitened = np.linalg.solve(factor, jacobian[rows].reshape(flat))
        taken = (whitened.reshape(-1, len(covariance)) @ covariance).reshape(flat)
        leverage, axes = np.linalg.eigh(taken @ whitened.transpose(0, 2, 1))
        error = np.linalg.solve(factor, error_mm[rows].reshape(flat))
        grown = 1.0 / (1.0 - np.clip(leverage, 0.0, _GREATEST_LEVERAGE))
        left = factor @ (axes @ (grown[:, :, None] * (axes.transpose(0, 2, 1) @ error)))
        out[rows] = left.reshape(len(rows), k, 3)
    return out
