"""Breaks: an instant after which the machine is different, such as a repair, a knock or a changed data set-up.

All parameters of the kinematics may differ after a break. A step effect of the library has fewer coefficients and is
named where it suffices. A break is reported only if no such effect explains it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calibration.gap.background.blocks import drift_block, event_block, time_blocks, times_or_order
from calibration.gap.background.search import ODDS, background_log_bayes_factor
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.projected.projection import Projection, from_products, rows_of
from calibration.gap.regimes import borders
from calibration.gap.result import Break
from calibration.observations import ROW, Floats

_BORDERS = 100
_LEAST_SAMPLES = 60
_SCALES = (0.1, 0.3, 1.0)  # possible sizes of the changes, in build tolerances
_GROSS = 8.0  # multiple of the median error beyond which a sample is downweighted


def find_break(problem: Problem, joint: JointFit) -> Break | None:
    """Return the break that is certain given the effects of a fit, or None.

    A break must also be more probable than errors that vary gradually with time.

    Args:
        problem: the data.
        joint: kinematics and effects.
    """
    samples, columns = problem.solution.samples, joint.context.observations.extra
    if len(samples) < _LEAST_SAMPLES:
        return None
    of_row = columns[ROW] if ROW in columns else times_or_order(joint.context)
    variable = "time_s" if of_row is columns.get("time_s") else ROW
    size = np.linalg.norm(joint.error_mm(problem.solution), axis=1)
    weight = np.minimum(1.0, (_GROSS * np.median(size) / np.maximum(size, 1e-9)) ** 2)
    counted = replace(joint, fit=replace(joint.fit, weight=weight))
    projection, values = problem.project(counted), samples.average(of_row[:, None])[:, 0]
    coarse = borders(values, _BORDERS)
    found = max(_two_machines(projection, values, coarse), default=None)
    if found is None or found[0] < ODDS:
        return None
    found = max(_two_machines(projection, values, _between_neighbours(values, coarse, found[1])))
    # The scatter of a one-machine fit includes errors that two machines would explain, so each alternative is compared
    # with its own scatter.
    context, border = joint.context, found[1]
    another = event_block(context, samples.average, of_row, border)
    drifting = [*time_blocks(context, samples.average, fine=True), drift_block(context, samples.average, of_row)]
    evidence = max(found[0], background_log_bayes_factor(problem, joint, [another]))
    if evidence < background_log_bayes_factor(problem, joint, drifting) + ODDS:
        return None
    before = int((values <= border).sum())
    return Break(variable, border, before, len(values) - before, evidence)


def _between_neighbours(values: Floats, coarse: Floats, border: float) -> Floats:
    """Return all borders between distinct values (m,) from the coarse border before `border` to the one after it."""
    at = int(np.searchsorted(coarse, border))
    first, last = coarse[max(at - 1, 0)], coarse[min(at + 1, len(coarse) - 1)]
    distinct = np.unique(values)
    every: Floats = 0.5 * (distinct[:-1] + distinct[1:])
    found: Floats = every[(every >= first) & (every <= last)]
    return found


def _two_machines(projection: Projection, values: Floats, each: Floats) -> list[tuple[float, float]]:
    """Return (log Bayes factor of two machines, border) for each of the borders `each` between values (m,)."""
    slice_of = np.searchsorted(each, values)
    kinematics = projection.kinematics[:, : projection.jacobian.shape[2]]
    index = [rows_of(np.flatnonzero(slice_of == number)) for number in range(len(each) + 1)]
    along = np.cumsum([kinematics[rows].T @ projection.target[rows] for rows in index][::-1], axis=0)[::-1]
    own = np.cumsum([kinematics[rows].T @ kinematics[rows] for rows in index][::-1], axis=0)[::-1]
    other = np.cumsum([projection.kinematics[rows].T @ kinematics[rows] for rows in index][::-1], axis=0)[::-1]
    soft, found = projection.without_kinematics, []
    removed_target = soft.removed(projection.target)
    prior = math.log(max(len(each), 1) * len(_SCALES))
    for number, border in enumerate(each, 1):
        removed = soft.removed_by(other[number])
        gram, right = own[number] - removed.T @ removed, along[number] - removed.T @ removed_target
        best = max(from_products(gram, right, np.full(len(right), scale)) for scale in _SCALES)
        found.append((best - prior, float(border)))
    return found
