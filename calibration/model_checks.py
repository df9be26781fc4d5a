"""What the numbers of a stored model must be, so that it predicts finite positions with finite deviations.

A manifest tells that files are as they were written, not that whoever wrote them meant a machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from calibration.errors import ModelError
from calibration.kinematics import Placement
from calibration.observations import Floats

LARGEST = 1e9  # size of lengths, angles and coefficients, in their units; squares of larger ones overflow in sums
_ROTATION_TOLERANCE = 1e-6
_CORRELATION_TOLERANCE = 1e-6  # of rounding in a covariance, as a share of its variances


def float_array(stored: Mapping[str, Any], name: str) -> Floats:
    """The array of that name as it was stored: KeyError if there is none, ValueError if it is not of float64."""
    array = np.asarray(stored[name])
    if array.dtype != np.float64:
        raise ValueError(f"{name} is an array of {array.dtype}, not of float64")
    return np.ascontiguousarray(array)


def check_placement(setup: str, placement: Placement) -> None:
    """Raise ModelError unless the base of a set-up is turned, neither stretched nor mirrored."""
    rotation = placement.rotation
    if not (
        np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ROTATION_TOLERANCE and float(np.linalg.det(rotation)) > 0.0
    ):
        raise ModelError(f"the base of set-up {setup!r} is no rotation; calibrate again")


def check_covariance(covariance: Floats, size: int, of: str) -> None:
    """Raise ModelError unless a matrix is a covariance of `size` numbers: symmetric, positive semidefinite, finite.

    Args:
        covariance: any matrix.
        size: how many numbers it must be of.
        of: what these are, for the message.
    """
    if covariance.shape != (size, size) or not (np.abs(covariance) <= LARGEST**2).all():
        raise ModelError(f"covariance.npz does not fit the {of} of model.json; calibrate again")
    # Variances of mm and of rad lie ten powers apart: only correlations have one scale.
    variance = np.diag(covariance)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    with np.errstate(over="ignore"):  # infinite correlations are refused below
        correlation = covariance / scale / scale[:, None]
    if (
        (variance < 0.0).any()
        or not (np.abs(correlation) <= 1.0 + _CORRELATION_TOLERANCE).all()
        or np.abs(correlation - correlation.T).max(initial=0.0) > _CORRELATION_TOLERANCE
        or np.linalg.eigvalsh(correlation).min(initial=0.0) < -_CORRELATION_TOLERANCE
    ):
        raise ModelError(
            f"covariance.npz holds no covariance of the {of} of model.json (it is not symmetric and positive "
            "semidefinite); calibrate again"
        )


def check_names(found: Iterable[str], known: tuple[str, ...], what: str) -> None:
    """Raise ModelError where a joint or prism is named that the rig lacks."""
    strange = [name for name in found if name not in known]
    if strange:
        raise ModelError(f"model.json speaks of {what} {strange[0]!r}, which its rig lacks; calibrate again")
