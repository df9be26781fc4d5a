"""Whether a candidate may be named: stable under resampling, true of held-out groups, within its limits.

The posterior alone is conditional on the library, the noise and the linear model; these ask the data themselves, in
what is left beside the kinematics that all of them determine: half of a few poses determines none.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np

from calibration.effects.base import Situation
from calibration.gap.projection import Projection, Softly, from_products, rows_of, without_folds
from calibration.gap.screen import Weighed
from calibration.observations import Floats
from calibration.paired_test import chance_of_mean
from calibration.residual.folds import folds

HALF_SAMPLES = 25
_FOLDS = 10


def wins(projection: Projection, family: Sequence[Weighed], rivals: Sequence[Weighed], seed: int) -> dict[str, float]:
    """Share of half-samples, drawn by group, in which a family has the greatest evidence, wherever it is.

    Where another effect is likely beside the first, it is there beside each of them. What it costs not to know a form,
    both halves share.

    Args:
        projection: about the fit.
        family: the candidate, and other places of its family that come near.
        rivals: those of other families that come near; nothing is a rival too.
        seed: of the halves.

    Returns:
        `family@where` -> share, the greatest first, of all that win any; the family by the name of the candidate.
    """
    weighed = [*family, *rivals]
    left = _left(projection, family[0], weighed)
    edges = np.cumsum([0, *(len(w.additions) for w in weighed)])
    labels, group = np.unique(projection.groups, return_inverse=True)
    rng = np.random.default_rng(seed)
    names = [str(family[0].place)] * len(family) + [str(w.place) for w in rivals]
    won = Counter[str]()
    for _ in range(HALF_SAMPLES):
        half = np.isin(group, rng.permutation(len(labels))[: (len(labels) + 1) // 2])
        rows = left[rows_of(np.flatnonzero(half))]
        values = []
        for w, (a, b) in zip(weighed, itertools.pairwise(edges.tolist()), strict=True):
            own = rows[:, a:b]
            values.append(0.5 * w.spread + from_products(own.T @ own, own.T @ rows[:, -1], np.ones(b - a)))
        best = int(np.argmax(values))
        if values[best] > 0.0:
            won[names[best]] += 1
    return {name: count / HALF_SAMPLES for name, count in won.most_common()}


def chance_of_foretelling(projection: Projection, candidate: Weighed, seed: int) -> float:
    """p that held-out groups go with what others say of a candidate no more than chance would (t-test, one-sided).

    Of few groups that have all of the evidence none foretells the others.
    """
    left = _left(projection, candidate, [candidate])
    columns, target = left[:, :-1], left[:, -1]
    along = np.empty(len(projection.groups))
    fold = folds(projection.groups, _FOLDS, seed)
    for number, x in without_folds(columns, target, fold):
        rows = rows_of(np.flatnonzero(fold == number))
        along[fold == number] = ((columns[rows] @ x) * target[rows]).reshape(-1, 3).sum(axis=1)
    group = np.unique(projection.groups, return_inverse=True)[1]
    return chance_of_mean(np.bincount(group, along).astype(np.float64))


def beyond(situation: Situation, candidate: Weighed) -> tuple[str, ...]:
    """Names of the coefficients that the linear estimate has beyond their hard limits by more than chance."""
    return candidate.choice.beyond(situation, candidate.estimate, candidate.standard_error)


def _left(projection: Projection, leading: Weighed, weighed: Sequence[Weighed]) -> Floats:
    """(3 m, k + 1) columns of several places and the target, without kinematics and what is likely beside the first."""
    columns = [_columns(projection, w) for w in weighed]
    softly = projection.softly
    if leading.beside is not None:
        softly = Softly(np.hstack([projection.rows.kinematics, _columns(projection, leading.beside)]))
    return softly(np.column_stack([*columns, projection.rows.target]))


def _columns(projection: Projection, weighed: Weighed) -> Floats:
    """(3 m, k) whitened, in prior sigmas."""
    whitened = projection.whitened(projection.moved_mm(weighed.additions))
    return whitened * (weighed.additions.prior_sigma * weighed.scale)
