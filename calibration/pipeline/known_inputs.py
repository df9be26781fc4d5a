"""Fits without the rows in which inputs of the fitted effects are unknown.

Such an effect counts as zero there. Its errors would remain in these rows, make its size too small, and be given other
names: rows of one pose without a direction of approach look like a zero that has moved for a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.effects.context import EffectContext
from calibration.effects.fitted import inputs_known, lacking_inputs
from calibration.errors import CalibrationError
from calibration.gap.adoption import Adopted
from calibration.gap.candidates import LEAST_KNOWN
from calibration.model.model import CalibratedModel
from calibration.observations import Observations, are_among
from calibration.run_settings import Run

T = TypeVar("T")

_LEAST_ROWS = 10  # known rows of a set-up or prism; with fewer, those that lack inputs are kept, too


def fitted_where_known(
    observations: Observations, run: Run, fit: Callable[[Observations, Run], T], adopted: Callable[[T], Adopted]
) -> tuple[T, Observations, Adopted]:
    """Fit kinematics and effects, and again without the rows that lack inputs of these effects.

    All rows of a set-up or prism are kept if few of them or less than half would be left. All rows are kept if the
    others cannot be fitted, or show no effect that needs the inputs.

    Args:
        observations: the rows.
        run: run of the first fit, whose checkpoint is not for others.
        fit: fits kinematics and effects to rows, and may find other effects in fewer rows.
        adopted: returns the kinematics and effects of a result of `fit`.

    Returns:
        The result of the last fit, its rows, and its kinematics and effects with warnings about rows that lack inputs.

    Raises:
        CalibrationError: as `fit` for all rows.
    """
    rows, found = observations, fit(observations, run)
    whole = found
    while True:
        kept = _with_small_parts(rows, _known(adopted(found), rows))
        if kept.all():
            break
        rows = rows.select(kept)
        try:
            found = fit(rows, replace(run, checkpoint=None))
        except CalibrationError:
            rows, found = observations, whole  # too few rows, for example
            break
    if len(rows) < len(observations) and _known(adopted(found), observations).all():
        rows, found = observations, whole
    taken = adopted(found)
    told = _warnings(taken, observations, rows)
    return found, rows, replace(taken, warnings=(*taken.warnings, *told))


def rows_of_fit(model: CalibratedModel, observations: Observations) -> Observations:
    """Return the rows to which a model was fitted; all rows if it was fitted to none of them.

    Args:
        model: the model.
        observations: the rows from which it was made.
    """
    fitted = are_among(observations, model.fitted_rows)
    return observations.select(fitted) if fitted.any() else observations


def _known(taken: Adopted, rows: Observations) -> NDArray[np.bool_]:
    return inputs_known(taken.effects, _context(taken, rows))


def _context(taken: Adopted, rows: Observations) -> EffectContext:
    chain = taken.solution.chain
    return EffectContext(chain, taken.solution.fit.x[: len(chain)], rows)


def _with_small_parts(rows: Observations, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of known rows with all rows of the set-ups and prisms of which few or less than half are."""
    kept = known.copy()
    for labels in (rows.setup, rows.prism):
        for label in np.unique(labels):
            own = labels == label
            if known[own].mean() < LEAST_KNOWN or known[own].sum() < _LEAST_ROWS:
                kept |= own
    return kept


def _warnings(taken: Adopted, observations: Observations, rows: Observations) -> Iterator[str]:
    """Yield how many rows are not used, and in how many of the others an effect counts as zero."""
    left_out = len(observations) - len(rows)
    if left_out:
        lacking = lacking_inputs(taken.effects, _context(taken, observations))
        needed = " or ".join(f"{needs}, which {effect.family}@{effect.where} needs" for effect, needs, _ in lacking)
        yield f"{left_out} of {len(observations)} rows are not used, because they lack {needed}"
    for effect, needs, number in lacking_inputs(taken.effects, _context(taken, rows)):
        yield (
            f"{effect.family}@{effect.where} counts as zero in {number} of {len(rows)} rows, which lack {needs}: its "
            "size may be too small, and part of it may have another name"
        )
