"""Drift of a live model: its errors on a check session relative to the predicted errors, per standstill."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.errors import UnsafeError
from calibration.evaluation.evaluation import require_positions
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.model.rebase import with_refitted_base
from calibration.numerics.single_thread import one_blas_thread
from calibration.numerics.statistics import score
from calibration.observations import Floats, Observations
from calibration.residual.folds import standstill_labels

_BASE = 6  # parameters of a base transform


@dataclass(frozen=True)
class Check:
    """Comparison of a check session with a model.

    Attributes:
        scores: score of each standstill, in the order of the rows, as returned by `statistics.score`.
        fixes: number of fixes.
        ratio: RMS of the errors divided by their formal standard deviation.
        refitted: set-ups that the model does not know, whose base was fitted on these same fixes.
        left_out: unknown set-ups whose fixes cannot determine a base.
    """

    scores: tuple[float, ...]
    fixes: int
    ratio: float
    refitted: tuple[str, ...]
    left_out: tuple[str, ...]


@one_blas_thread()
def check(model: CalibratedModel, observations: Observations) -> Check:
    """Compare a check session with a model that was not trained on it.

    Args:
        model: the live model.
        observations: rows of the session, with positions, in the order of time.

    Raises:
        DataError: no rows, or rows without positions.
        UnsafeError: no set-up of the session has a known base or fixes that can determine one.
    """
    require_positions(observations)
    squares = np.full(len(observations), np.nan)
    refitted: list[str] = []
    left_out: list[str] = []
    for setup in sorted(set(observations.setup.tolist())):
        rows = np.flatnonzero(observations.setup == setup)
        here = observations.select(rows)
        if setup in model.placements:
            squares[rows] = _mean_squares(model, here)
            continue
        spare = 3 * len(rows) - _BASE
        try:
            placed = with_refitted_base(model, here) if spare > 0 else None
        except UnsafeError:
            placed = None
        if placed is None:
            left_out.append(setup)
            continue
        # The fitted base absorbs part of these errors, and its uncertainty adds to their predicted variance
        squares[rows] = _mean_squares(placed, here) * (3 * len(rows) + _BASE) / spare
        refitted.append(setup)
    known = np.isfinite(squares)
    if not known.any():
        raise UnsafeError(
            f"the check shots cannot determine the base transform: at set-up {left_out[0]!r}, which the live model "
            "does not know, measure at least three fixes that are not on a line"
        )
    squares, labels = squares[known], standstill_labels(observations.select(known))
    found = [float(squares[labels == label].mean()) for label in dict.fromkeys(labels.tolist())]
    return Check(
        scores=tuple(score(square) for square in found),
        fixes=int(known.sum()),
        ratio=math.sqrt(float(squares.mean())),
        refitted=tuple(refitted),
        left_out=tuple(left_out),
    )


def _mean_squares(model: CalibratedModel, observations: Observations) -> Floats:
    """Return (n,) squared errors divided by their formal variance, averaged over the three coordinates."""
    predicted = Predictor.of(model).predict(observations)
    squares: Floats = (((observations.position_mm - predicted.position_mm) / predicted.formal_mm) ** 2).mean(axis=1)
    return squares
