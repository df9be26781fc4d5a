"""Fits without the rows in which inputs of the fitted effects are unknown.

Such an effect counts as zero there. Its errors would remain in these rows, make its size too small, and be given other
names: rows of one pose without a direction of approach look like a zero that has moved for a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.effects.context import EffectContext
from calibration.effects.fitted import FittedEffect, inputs_known, lacking_inputs
from calibration.errors import UnsafeError
from calibration.gap.adoption import Adopted
from calibration.gap.candidates import LEAST_KNOWN
from calibration.model.model import CalibratedModel
from calibration.model.prediction import Predictor
from calibration.observations import Observations
from calibration.run_settings import Run

T = TypeVar("T")


def fitted_where_known(
    observations: Observations, run: Run, fit: Callable[[Observations, Run], T], adopted: Callable[[T], Adopted]
) -> tuple[T, Observations, Adopted]:
    """Fit kinematics and effects, and again without the rows that lack inputs of these effects.

    All rows of a set-up or prism are kept if more than half of them lack inputs, and all rows if too few are left.

    Args:
        observations: the rows.
        run: run of the first fit, whose checkpoint is not for others.
        fit: fits kinematics and effects to rows, and may find other effects in fewer rows.
        adopted: returns the kinematics and effects of a result of `fit`.

    Returns:
        The result of the last fit, its rows, and its kinematics and effects with warnings about the rows left out.

    Raises:
        CalibrationError: as `fit` for all rows.
    """
    rows, told = observations, tuple[str, ...]()
    found = fit(rows, run)
    while True:
        effects, context = adopted(found).effects, _context(adopted(found), rows)
        kept = _with_unknown_labels(rows, inputs_known(effects, context))
        if kept.all():
            break
        try:
            found = fit(rows.select(kept), replace(run, checkpoint=None))
        except UnsafeError:
            break  # too few rows
        told += (_sentence(rows, kept, lacking_inputs(effects, context)),)
        rows = rows.select(kept)
    taken = adopted(found)
    return found, rows, replace(taken, warnings=(*taken.warnings, *told))


def _sentence(rows: Observations, kept: NDArray[np.bool_], lacking: Sequence[tuple[FittedEffect, str, int]]) -> str:
    needed = " or ".join(f"{needs}, which {effect.family}@{effect.where} needs" for effect, needs, _ in lacking)
    return f"{(~kept).sum()} of {len(rows)} rows are not used, because they lack {needed}"


def _context(taken: Adopted, rows: Observations) -> EffectContext:
    chain = taken.solution.chain
    return EffectContext(chain, taken.solution.fit.x[: len(chain)], rows)


def _with_unknown_labels(rows: Observations, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of known rows with all rows of the set-ups and prisms of which less than half are known."""
    kept = known.copy()
    for labels in (rows.setup, rows.prism):
        for label in np.unique(labels):
            own = labels == label
            if known[own].mean() < LEAST_KNOWN:
                kept |= own
    return kept


def where_known(model: CalibratedModel, observations: Observations) -> Observations:
    """Return the rows for which `fitted_where_known` would fit the effects of a model."""
    known = inputs_known(model.effects, Predictor.of(model).context(observations))
    return observations.select(_with_unknown_labels(observations, known))
