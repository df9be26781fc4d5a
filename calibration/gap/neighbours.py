"""Whether what is left goes together in samples near each other, whatever the formula.

Terms find what they have words for. An error that swings with the time, ripples with the range or sits in one corner of
the work volume may have none and look like noise that is larger than it should be; but noise is another one in the next
sample, and an error that depends on something is nearly the same where that is nearly the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from calibration.gap.projection import Integers, Projection
from calibration.observations import Floats

_NEAREST = 4
_WANDERS = 0.1  # share of the variance that noise may share with its neighbours: air, a tripod in the sun
_LEAST = 30  # pairs
_LEAST_MM = 1e-6


@dataclass(frozen=True)
class Along:
    """What neighbours along one variable share.

    Attributes:
        where, variable: place and variable, as of a disagreement.
        shared: products of the residuals of neighbours, summed, beyond what noise may share.
        chance: (draws,) the same where neighbours have nothing in common.
    """

    where: str
    variable: str
    shared: float
    chance: Floats


def neighbours(projection: Projection, rng: np.random.Generator, draws: int) -> Iterator[Along]:
    """What is shared along the time, along the range (of errors along the line of sight), and in the work volume.

    Pairs within a group are left out: fixes of a standstill share the errors of its readings.

    Args:
        projection: whose residual.
        rng: draws the signs of groups.
        draws: how often.
    """
    residual = projection.residual.reshape(-1, 3)
    groups, group = np.unique(projection.groups, return_inverse=True)
    signs = 2.0 * rng.integers(0, 2, (draws, len(groups))) - 1.0
    # Where the model has them: as measured, fixes of a prism that stands still would be neighbours by their noise.
    place_mm = projection.samples.position_mm - projection.error_mm
    range_mm = np.linalg.norm(place_mm, axis=1)[:, None]
    sight = place_mm / np.maximum(range_mm, _LEAST_MM)
    time_s = projection.samples.average(projection.situation.extra("time_s")[:, None])
    for where, variable, at, error in (
        ("base", "time", time_s, residual),
        ("station", "range", range_mm, (residual * sight).sum(axis=1)[:, None]),
        ("station", "place", place_mm, residual),
    ):
        a, b = _pairs(at, group)
        if len(a) < _LEAST:
            continue
        product = (error[a] * error[b]).sum(axis=1)
        between = coo_array((product, (group[a], group[b])), shape=(len(groups), len(groups))).tocsr()
        sizes = 0.5 * ((error[a] ** 2).sum(axis=1) + (error[b] ** 2).sum(axis=1))
        yield Along(
            where,
            variable,
            float(product.sum() - _WANDERS * sizes.sum()),
            ((signs @ between) * signs).sum(axis=1),
        )


def _pairs(at: Floats, group: Integers) -> tuple[Integers, Integers]:
    """Every sample with its nearest, each pair once, none within a group (m,)."""
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    if len(known) <= _NEAREST:
        return known[:0], known[:0]
    nearest = cKDTree(at[known]).query(at[known], _NEAREST + 1)[1]
    pairs = np.column_stack([np.repeat(known, _NEAREST + 1), known[nearest].ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = pairs[group[pairs[:, 0]] != group[pairs[:, 1]]].T
    return a, b
