"""Latency of fixes relative to the joint readings, estimated from fixes of a moving boom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import require_positions
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.numerics.single_thread import one_blas_thread
from calibration.observations import Floats, Observations

PAUSE_S = 1.0  # between two motions
LEAST_MOTIONS = 5
LEAST_FIXES = 30
LEAST_SPEED_MM_PER_S = 5.0  # at lower speeds the errors of the model dominate
LAG_MM = 5.0  # standard deviation of the lag of the boom by play and friction, independent of its speed
OFFSET_MM = 50.0  # standard deviation of the model's mean error where the boom moved
_OUTLIER = 5.0  # multiple of the typical error
_ROUNDS = 3


@dataclass(frozen=True)
class Latency:
    """Delay of fixes relative to the joint readings, estimated from fixes of a moving boom.

    Attributes:
        seconds: delay from the true instant of a fix to its timestamp, minus the same delay of the joint readings. It
            does not include a delay that the joiner has already removed, or one that is an effect of the model.
        standard_error_s: standard error of `seconds`; motions are treated as independent, fixes of one motion are not.
        fixes: number of fixes used for the estimate.
        motions: number of motions that these fixes belong to.
    """

    seconds: float
    standard_error_s: float
    fixes: int
    motions: int


@one_blas_thread()
def estimate_latency(model: CalibratedModel, observations: Observations) -> Latency | str:
    """Estimate the latency of one session's fixes.

    The error of a fix is regressed on the prism's velocity, together with a constant error and a lag along the motion
    due to play and friction. Different speeds separate the lag from the latency; without them the standard error is
    large. Motion shows only the difference between the latencies of the two links: the latency of one link alone needs
    a common clock.

    Args:
        model: model that was identified without these fixes, or with few of them.
        observations: moving fixes with positions, `time_s` and rates, at one set-up, in the order of time.

    Returns:
        The latency, or a clause with the reason why it is not known.

    Raises:
        DataError: no rows, or rows without positions.
    """
    require_positions(observations)
    time_s = observations.extra.get("time_s")
    if time_s is None:
        return "the fixes have no times"
    if observations.setup[0] not in model.placements:
        try:
            model = with_refitted_base(model, observations)
        except UnsafeError as error:
            return str(error)
    predictor = Predictor.of(model)
    velocity = predictor.context(observations).velocity_mm_per_s
    speed = np.sqrt((velocity**2).sum(axis=1))
    is_quick = speed >= LEAST_SPEED_MM_PER_S
    motion = np.cumsum(np.diff(time_s, prepend=-np.inf) > PAUSE_S)
    error_mm = observations.position_mm - predictor.predict(observations).position_mm
    rows = is_quick & np.isfinite(error_mm).all(axis=1)
    few = f"{LEAST_FIXES} fixes in {LEAST_MOTIONS} motions are needed"
    for _ in range(_ROUNDS):
        if rows.sum() < LEAST_FIXES or len(np.unique(motion[rows])) < LEAST_MOTIONS:
            return f"{few}; there are {rows.sum()} in {len(np.unique(motion[rows]))}"
        design = _design(velocity[rows], speed[rows])
        found, covariance = _fit(design, error_mm[rows], motion[rows])
        left = np.sqrt(((error_mm - _design(velocity, np.maximum(speed, 1e-9)) @ found) ** 2).sum(axis=1))
        kept = is_quick & np.isfinite(left) & (left <= _OUTLIER * np.median(left[rows]))
        if (kept == rows).all():
            break
        rows = kept
    return Latency(
        seconds=-float(found[0]),
        standard_error_s=float(np.sqrt(covariance[0, 0])),
        fixes=int(rows.sum()),
        motions=len(np.unique(motion[rows])),
    )


def _design(velocity: Floats, speed: Floats) -> Floats:
    """Return (n, 3, 5) columns: velocity, direction of motion, and a constant error of each coordinate."""
    constant = np.broadcast_to(np.eye(3), (len(velocity), 3, 3))
    return np.concatenate([velocity[:, :, None], (velocity / speed[:, None])[:, :, None], constant], axis=2)


def _fit(design: Floats, error_mm: Floats, motion: NDArray[np.int_]) -> tuple[Floats, Floats]:
    """Return coefficients of a ridge regression and their covariance, robust to errors shared within a motion."""
    precision = np.diag([0.0, LAG_MM**-2, *[OFFSET_MM**-2] * 3])
    columns = design.reshape(-1, design.shape[2])
    variance = 1.0
    for _ in range(2):  # the weight of the prior needs the noise
        normal = columns.T @ columns / variance + precision
        found = np.linalg.solve(normal, np.asarray(columns.T @ error_mm.ravel() / variance))
        left = error_mm - design @ found
        variance = float((left**2).mean())
    scores = np.einsum("nij,ni->nj", design, left) / variance
    labels = np.unique(motion, return_inverse=True)[1]
    count = int(labels.max()) + 1
    by_motion = np.zeros((count, design.shape[2]))
    np.add.at(by_motion, labels, scores)
    middle = by_motion.T @ by_motion * count / (count - 1) + precision
    inverse = np.linalg.inv(normal)
    return np.asarray(found, dtype=np.float64), inverse @ middle @ inverse
