"""Regimes: effects that act in only a part of the data, found by the evidence of every effect in every part.

A part is the rows in which a variable is above a border, or the other rows. Products of columns are summed over slices
of the variable, so that many borders cost little more than one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from calibration.effects.columns import EffectColumns
from calibration.effects.fitted import Choice
from calibration.effects.regime import Regime, variables
from calibration.gap.candidates import CandidateEffect, candidate_at, each_candidate, variants_at
from calibration.gap.detection import FAR, detect
from calibration.gap.formulas.grammar import Grammar
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.projected.projection import Integers, Projection, SoftProjection, rows_of
from calibration.gap.screening import Screen
from calibration.numerics.matrices import gram
from calibration.observations import Floats

_BORDERS = 6  # borders of a variable in the screening
_SCREENED = 500  # samples used in the screening
_LEAST = 0.05  # smallest share of the samples on either side of a border
_MOST_FORMS = 40  # largest number of variants of a candidate; step effects have more
_FITTED = 8  # effects that are fitted per round
_FIRST = 3  # fits after which the search for a last effect may be abandoned
_ROUNDS = 2
_PASSES = 3  # iterations between border and fit
_LEAST_PROGRESS = 0.5  # share of the required gain that the best fit of a round must reach to continue
_OUTLIER = 6.0  # larger errors, in medians, are clipped to this value
_HALF = 0.5
_AT_ONCE = 1_000_000  # values of products per batch, to fit into the processor's caches and to save memory
_WIDE = 50  # blocks with this many columns are of curves, with mostly zero values
_REGIME = math.log(0.1)  # log prior probability that an effect acts only in a part
_LIKELY = 3.0  # factor on plausible sizes, as only a large effect is visible in a part
_BETTER = math.log(999.0)  # log odds required against no effect
_POSTERIOR = 0.95  # required of an effect among all fitted ones, and of its variable among all variables


@dataclass(frozen=True)
class EffectInRegime:
    """An effect that acts in a part of the data.

    Attributes:
        joint: the fit, with this effect as its last.
        posterior: posterior probability among all effects and parts.
    """

    joint: JointFit
    posterior: float

    @property
    def choice(self) -> Choice:
        """The effect, with its regime."""
        return self.joint.choices[-1]


def effect_in_regime(
    problem: Problem,
    joint: JointFit,
    families: Collection[str],
    like: Sequence[CandidateEffect] = (),
    most_cost: float = math.inf,
    *,
    is_last: bool = False,
) -> EffectInRegime | None:
    """Return the effect of greatest evidence in a part of the data, if it is certain.

    Args:
        problem: the data.
        joint: kinematics and present effects, with the weights to use; a present effect of the same name is replaced.
        families: families of effects to try.
        like: candidates of an earlier fit, most of whose columns can be reused.
        most_cost: largest useful cost of a fit, nats.
        is_last: True if only a fit that leaves nothing but noise is useful.

    Returns:
        The effect; None if no effect is certain and useful.
    """
    needed = joint.fit.cost - most_cost
    fitted: dict[str, _Fitted] = {}
    about = problem.project(joint)
    for _ in range(_ROUNDS):
        promising = [choice for choice, log_odds in _screened(about, families, like) if log_odds > _BETTER]
        for number, choice in enumerate(promising[:_FITTED]):
            if is_last and number == _FIRST and _leaves_much(problem, fitted.values()):
                return None
            if str(choice) not in fitted:
                fitted[str(choice)] = _fitted(problem, joint, choice)
        if not fitted:
            return None
        best = min(fitted.values(), key=lambda own: own.joint.fit.cost)
        if joint.fit.cost - best.joint.fit.cost < _LEAST_PROGRESS * needed:
            return None
        # Effects that are similar at the noise of the kinematics may differ clearly at the noise of the true effect.
        about = problem.project(best.joint, without_last=True)
    cost = [own.joint.fit.cost for own in fitted.values() if not own.joint.beyond_limits(len(own.joint.choices) - 1)]
    if best.joint.fit.cost not in cost:  # beyond its hard limits
        return None
    posterior = 1.0 / sum(math.exp(best.joint.fit.cost - own) for own in cost)
    is_certain = min(posterior, best.posterior) > _POSTERIOR
    return EffectInRegime(best.joint, posterior) if is_certain else None


@dataclass(frozen=True)
class _Fitted:
    """A fit whose last effect acts in a part of the data.

    Attributes:
        joint: the fit.
        posterior: posterior probability of the part's variable and side, given the effect.
    """

    joint: JointFit
    posterior: float


def _leaves_much(problem: Problem, fitted: Collection[_Fitted]) -> bool:
    """Return True if the best fit leaves so much structure that no less promising one can leave only noise."""
    best = min(fitted, key=lambda own: own.joint.fit.cost)
    return detect(Grammar(problem.project(best.joint)), problem.rng()).p < FAR


def _fitted(problem: Problem, joint: JointFit, choice: Choice) -> _Fitted:
    """Return the fit of a further effect in the part of the data, by any variable, that minimises the errors.

    The border is optimised with clipped errors of all rows, as a row on the wrong side of it looks like an outlier and
    has no weight in the fit.
    """
    others = [c for c in joint.choices if str(c) != str(choice)]
    found = problem.fit([*others, choice], joint.start(others))
    for _ in range(_PASSES):
        part, posterior = _best_part(problem, found)
        choice = _best_form(problem, found, part)
        if choice == found.choices[-1]:
            break
        found = problem.fit([*others, choice], joint.start(others))
    return _Fitted(found, posterior)


def _best_form(problem: Problem, joint: JointFit, part: Regime) -> Choice:
    """Return the last effect of a fit in its best variant in a part of the data."""
    last, projection = joint.choices[-1], problem.project(joint, without_last=True)
    forms = [replace(form, regime=part) for form in variants_at(joint.context, last.family, last.where)]
    own = candidate_at(joint.context, projection, last.family, last.where, forms)
    return Screen(projection, [own]).score()[0].choice


def _best_part(problem: Problem, joint: JointFit) -> tuple[Regime, float]:
    """Return the part in which a fit's last effect gives the smallest errors, and the probability of its variable."""
    choice, own = joint.choices[-1], joint.slice_of(len(joint.choices) - 1)
    assert choice.regime is not None
    samples, context = problem.solution.samples, joint.context
    whole = replace(choice, regime=None).columns(context).over(samples.average)
    moved = problem.project(joint).moved_mm(whole) @ joint.fit.x[own]
    inside = samples.average(choice.regime.holds(context).astype(np.float64)[:, None]) > _HALF
    without = joint.error_mm(problem.solution) + np.where(inside, moved, 0.0)
    error = np.stack([np.linalg.norm(without, axis=1), np.linalg.norm(without - moved, axis=1)])
    usual = float(np.median(np.where(inside[:, 0], error[1], error[0])))
    outside, within = np.minimum((error / usual) ** 2, _OUTLIER**2)
    found: list[tuple[float, Regime]] = []
    for variable, of_row in variables(context).items():
        values = samples.average(of_row[:, None])[:, 0]
        border, order = borders(values, len(values)), np.argsort(values)
        if not len(border):
            continue
        count = np.searchsorted(values[order], border)
        gain = np.concatenate([[0.0], np.cumsum((outside - within)[order])])
        for above, cost in ((True, gain[count]), (False, -gain[count])):
            # Samples up to a border are outside a part above it.
            total = cost + (within if above else outside).sum()
            best = int(total.argmin())
            found.append((float(total[best]), Regime(variable, above, float(border[best]))))
    least, part = min(found, key=lambda f: f[0])
    return part, 1.0 / float(np.exp([least - total for total, _ in found]).sum())


def _screened(
    projection: Projection, families: Collection[str], like: Sequence[CandidateEffect] = ()
) -> list[tuple[Choice, float]]:
    """Return every candidate in its best part with its log odds, the most probable first.

    The odds are against no effect and averaged over variants, sides and borders.
    """
    every = each_candidate(projection.context, projection, families, like)
    values = {name: projection.samples.average(v[:, None])[:, 0] for name, v in variables(projection.context).items()}
    log_prior = _REGIME - math.log(2.0 * max(len(values), 1))
    some = np.unique(np.linspace(0, len(projection.samples) - 1, _SCREENED).astype(np.intp))
    columns = _Columns(projection, (c for c in every if len(set(c.first_equal)) <= _MOST_FORMS), some)
    found: dict[int, tuple[Choice, float]] = {}
    for variable, own in values.items():
        border = borders(own, _BORDERS)
        if not len(border):
            continue
        slice_of = np.searchsorted(border, np.where(np.isfinite(own), own, -math.inf))[some]
        for number, evidence in enumerate(columns.evidence(len(border), slice_of)):
            most, candidate = float(evidence.max()), columns.candidates[number]
            together = most + math.log(float(np.exp(evidence - most).sum()) / len(border))
            log_odds = together + candidate.log_prior + log_prior
            if number not in found or log_odds > found[number][1]:
                option, at, above = np.unravel_index(int(evidence.argmax()), evidence.shape)
                regime = Regime(variable, bool(above), float(border[at]))
                found[number] = replace(candidate.options[option], scale=_LIKELY, regime=regime), log_odds
    return sorted(found.values(), key=lambda own: -own[1])


def borders(values: Floats, count: int) -> Floats:
    """Return borders between values, midway between neighbours and evenly spaced in rank.

    Args:
        values: (m,) values, NaN where not known.
        count: largest number of borders.
    """
    known = np.sort(values[np.isfinite(values)])
    at = np.unique((np.linspace(_LEAST, 1.0 - _LEAST, count) * len(known)).astype(int))
    distinct = np.unique(known)
    place = np.unique(np.searchsorted(distinct, known[at[at < len(known)]]))
    border = (distinct[place[place > 0]] + distinct[place[place > 0] - 1]) / 2.0
    share = np.searchsorted(known, border) / max(len(known), 1)
    found: Floats = border[(share >= _LEAST) & (share <= 1.0 - _LEAST)]
    return found


class _Use(NamedTuple):
    """A variant of a candidate that uses a block of columns, and the prior sigmas (k,) of the columns."""

    candidate: int
    option: int
    sigma: Floats


class _Columns:
    """Whitened columns of candidates, and their evidence in parts of some samples of a projection.

    Args:
        projection: projection at a fit.
        candidates: the effects, read one at a time so that columns for all samples are held for only one of them.
        some: (s,) indices of the samples to use.

    Attributes:
        candidates: the effects, without columns.
    """

    def __init__(self, projection: Projection, candidates: Iterable[CandidateEffect], some: Integers) -> None:
        rows = rows_of(some)
        self._kinematics, self._target = projection.kinematics[rows], projection.target[rows]
        self._without = SoftProjection(self._kinematics)
        self._removed_target = self._without.removed(self._target)
        self.candidates: list[CandidateEffect] = []
        self._of: dict[int, list[list[_Use]]] = {}  # number of columns -> variants that use each block
        self._by_reading: dict[int, csr_array] = {}
        own_rows: dict[int, list[Floats]] = {}
        for number, candidate in enumerate(candidates):
            uses: dict[int, list[_Use]] = {}
            for option, first in enumerate(candidate.first_equal):
                additions = candidate.additions[option]
                if option == first:
                    uses[option] = []
                    self._of.setdefault(len(additions), []).append(uses[option])
                    own_rows.setdefault(len(additions), []).append(self._whitened(projection, additions, rows))
                uses[first].append(_Use(number, option, _LIKELY * additions.prior_sigma))
            self.candidates.append(replace(candidate, additions=()))
        self._rows = {width: np.hstack(own_rows.pop(width)) for width in self._of}

    def _whitened(self, projection: Projection, additions: EffectColumns, rows: Integers) -> Floats:
        """Return the whitened columns of an effect in `rows` (r,), without computing other rows where possible."""
        joints = set(additions.joint.tolist())
        if additions.shift_mm is not None or len(joints) != 1:
            whole = projection.whitened(projection.moved_mm(additions))
            return whole[rows]
        joint = joints.pop()
        if joint not in self._by_reading:
            self._by_reading[joint] = projection.whitened_by_reading(joint)[rows]
        return np.asarray(self._by_reading[joint] @ additions.column)

    def evidence(self, borders: int, slice_of: Integers) -> list[Floats]:
        """Return the log evidence of each candidate in parts, including the prior odds of its variants.

        Args:
            borders: number of borders; samples of slice i are above the first i borders.
            slice_of: (s,) slice of each sample.

        Returns:
            For each candidate (options, borders, 2): the part at or below each border, and the part above it.
        """
        index = [rows_of(np.flatnonzero(slice_of == number)) for number in range(borders + 1)]
        found: list[dict[int, Floats]] = [{} for _ in self.candidates]
        for width, uses in self._of.items():
            step = max(_AT_ONCE // (2 * borders * width**2), 1)
            for first in range(0, len(uses), step):
                columns = self._rows[width][:, first * width : (first + step) * width]
                products = self._products(columns, width, index)
                for number, option, own in _each_use(uses[first : first + step], *products):
                    found[number][option] = own + self.candidates[number].log_odds[option]
        return [np.array([own[option] for option in range(len(own))]) for own in found]

    def _products(self, columns: Floats, width: int, index: Sequence[Integers]) -> tuple[Floats, Floats]:
        """Return products (o, b, 2, k, k) of blocks of projected columns, and products with the target (o, b, 2, k).

        Args:
            columns: (3 m, o k) columns of o blocks.
            width: number of columns k of each block.
            index: row indices of each of the b + 1 slices.
        """
        with_kinematics, with_target, grams = [], [], []
        for rows in index:
            own = columns[rows]
            with_kinematics.append(self._kinematics[rows].T @ own)
            with_target.append(self._target[rows] @ own)
            blocks = np.ascontiguousarray(own.reshape(len(own), -1, width).swapaxes(0, 1))
            is_wide = width >= _WIDE
            grams.append(np.stack([gram(block) for block in blocks]) if is_wide else blocks.swapaxes(1, 2) @ blocks)
        removed = self._without.removed_by(_on_both_sides(with_kinematics))
        along = _on_both_sides(with_target) - np.einsum("...qk,q->...k", removed, self._removed_target)
        removed = np.moveaxis(removed.reshape(*removed.shape[:3], -1, width), 3, 0)
        products = np.moveaxis(_on_both_sides(grams), 2, 0) - removed.swapaxes(-1, -2) @ removed
        return products, np.moveaxis(along.reshape(*along.shape[:2], -1, width), 2, 0)


def _each_use(uses: Sequence[Sequence[_Use]], products: Floats, along: Floats) -> Iterator[tuple[int, int, Floats]]:
    """Yield candidate, option and log Bayes factors (b, 2) of all variants that use any of o blocks of columns."""
    for turn in range(max(map(len, uses))):
        block = [number for number, own in enumerate(uses) if len(own) > turn]
        sigma = np.array([uses[number][turn].sigma for number in block])
        values = _log_bayes_factors(products[block], along[block], sigma[:, None, None])
        for number, own in zip(block, values, strict=True):
            yield uses[number][turn].candidate, uses[number][turn].option, own


def _on_both_sides(slices: Sequence[Floats]) -> Floats:
    """Return sums (b, 2, ...) below and above each of b borders, from the sums of the b + 1 slices between them."""
    below = np.cumsum(slices, axis=0)
    return np.stack([below[:-1], below[-1] - below[:-1]], axis=1)


def _log_bayes_factors(products: Floats, along: Floats, sigma: Floats) -> Floats:
    """Return log Bayes factors (...), as `from_products`, for arguments (..., k, k), (..., k) and (..., k)."""
    count, right = products.shape[-1], along * sigma
    # The last row of the bordered matrix's factor solves the system; the corner only makes it positive definite.
    bordered = np.empty((*products.shape[:-2], count + 1, count + 1))
    bordered[..., :count, :count] = products * sigma[..., None] * sigma[..., None, :] + np.eye(count)
    bordered[..., count, :count] = bordered[..., :count, count] = right
    bordered[..., count, count] = 1.0 + 2.0 * (right**2).sum(axis=-1)
    factor = np.linalg.cholesky(bordered)
    log_root = np.log(np.diagonal(factor, axis1=-2, axis2=-1)[..., :count]).sum(axis=-1)
    out: Floats = 0.5 * (factor[..., count, :count] ** 2).sum(axis=-1) - log_root
    return out
