"""Whether a candidate may be named: stable under resampling, better on held-out groups, within its limits.

The posterior alone is conditional on the library, the noise and the linear model; these ask the data themselves.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from calibration.effects.base import Situation
from calibration.gap.projection import Integers, Projection, from_products, rows_of, without_folds
from calibration.gap.screen import Weighed
from calibration.observations import Floats
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
    columns = [_columns(projection, w) for w in weighed]
    kinematics = _with_beside(projection, family[0])
    every = np.hstack([kinematics, *columns, projection.rows.target[:, None]])
    edges = np.cumsum([0, *(w.shape[1] for w in columns)])
    labels, group = np.unique(projection.groups, return_inverse=True)
    rng = np.random.default_rng(seed)
    names = [str(family[0].place)] * len(family) + [str(w.place) for w in rivals]
    won = Counter[str]()
    for _ in range(HALF_SAMPLES):
        half = np.isin(group, rng.permutation(len(labels))[: (len(labels) + 1) // 2])
        left = _without_first(every[rows_of(np.flatnonzero(half))], kinematics.shape[1])
        values = [
            0.5 * w.spread + from_products(left[a:b, a:b], left[a:b, -1], np.ones(b - a))
            for w, (a, b) in zip(weighed, itertools.pairwise(edges.tolist()), strict=True)
        ]
        best = int(np.argmax(values))
        if values[best] > 0.0:
            won[names[best]] += 1
    return {name: count / HALF_SAMPLES for name, count in won.most_common()}


def chance_of_gain(projection: Projection, candidate: Weighed, seed: int) -> float:
    """p that a candidate lowers the errors of held-out groups no more than chance would (Wilcoxon, one-sided).

    Both models are fitted without the groups, kinematics with their priors. By ranks: single fixes far from all
    others, where neither knows anything, would decide about a mean.
    """
    from scipy.stats import wilcoxon

    kinematics, fold = _with_beside(projection, candidate), folds(projection.groups, _FOLDS, seed)
    before = _held_out(kinematics, projection.rows.target, fold)
    after = _held_out(np.hstack([kinematics, _columns(projection, candidate)]), projection.rows.target, fold)
    _, group, size = np.unique(projection.groups, return_inverse=True, return_counts=True)
    lowered = np.bincount(group, before - after) / size
    return float(wilcoxon(lowered, alternative="greater").pvalue) if np.any(lowered) else 1.0


def beyond(situation: Situation, candidate: Weighed) -> tuple[str, ...]:
    """Names of the coefficients that the linear estimate has beyond their hard limits by more than chance."""
    return candidate.choice.beyond(situation, candidate.estimate, candidate.standard_error)


def _columns(projection: Projection, weighed: Weighed) -> Floats:
    """(3 m, k) whitened, in prior sigmas."""
    whitened = projection.whitened(projection.moved_mm(weighed.additions))
    return whitened * (weighed.additions.prior_sigma * weighed.scale)


def _with_beside(projection: Projection, weighed: Weighed) -> Floats:
    """(3 m, q) kinematics, and the effect that is likely beside a candidate."""
    if weighed.beside is None:
        return projection.rows.kinematics
    return np.hstack([projection.rows.kinematics, _columns(projection, weighed.beside)])


def _without_first(rows: Floats, first: int) -> Floats:
    """(k, k) products of whitened columns (r, first + k) with those before `first`, of unit priors, taken out."""
    products = rows.T @ rows
    factor = np.linalg.cholesky(products[:first, :first] + np.eye(first))
    taken = solve_triangular(factor, products[:first, first:], lower=True)
    left: Floats = products[first:, first:] - taken.T @ taken
    return left


def _held_out(design: Floats, target: Floats, fold: Integers) -> Floats:
    """(m,) squares of every sample's whitened error, by fits with unit priors without its fold (m,)."""
    squares = np.empty(len(fold))
    for number, x in without_folds(design, target, fold):
        rows = rows_of(np.flatnonzero(fold == number))
        squares[fold == number] = ((target[rows] - design[rows] @ x) ** 2).reshape(-1, 3).sum(axis=1)
    return squares
