"""Regimes: effects that act in a part of the data only, found by the evidence of every effect in every part.

The part is the rows in which a variable is above a border, or all others. Products of columns are summed over slices of
the variable, so that all borders of it cost little more than one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from calibration.effects.fitted import Choice
from calibration.effects.regime import Regime, variables
from calibration.gap.candidates import CandidateEffect, candidate_effects
from calibration.gap.joint_fit import JointFit, Problem
from calibration.gap.projection import Integers, Projection, rows_of
from calibration.gap.screening import LOG_SCALE_ODDS, SCALES
from calibration.observations import Floats

_COARSE, _FINE, _FINEST = 6, 24, 200  # borders of a variable: for all hypotheses, for the best, and at the end
_COMPARED = 30  # hypotheses, and effects
_LIKELY = (3.0,)  # scale at which all hypotheses are compared
_LEAST = 0.05  # share of the samples on either side of a border
_MOST_FORMS = 40  # of a candidate: one with more is a step at any time
_FITTED = 8  # hypotheses that are fitted
_PASSES = 3  # of a border and the fit that it depends on
_HALF = 0.5
_OUTLIER = 6.0  # median errors: more is no worse
_REGIME = math.log(0.1)  # prior probability that an effect acts in a part only
_POSTERIOR = 0.95  # of an effect and its variable, among all
_BETTER = math.log(999.0)  # log odds against all rows


@dataclass(frozen=True)
class _Hypothesis:
    """An effect in one part of the data, or in all.

    Attributes:
        choice: in its best form, at the best border.
        log_bayes_factor: against nothing, averaged over forms and borders.
        log_odds: that with the prior odds.
    """

    choice: Choice
    log_bayes_factor: float
    log_odds: float


@dataclass(frozen=True)
class EffectInRegime:
    """An effect that acts in a part of the data.

    Attributes:
        choice: the effect, with its regime.
        posterior: probability of the effect in this part among all effects and parts.
    """

    choice: Choice
    posterior: float


def effect_in_regime(problem: Problem, joint: JointFit, families: Collection[str]) -> EffectInRegime | None:
    """Return the effect of greatest evidence in a part of the data, where that is beyond doubt.

    Args:
        problem: the data.
        joint: kinematics and effects that are there, with the weights that count; one of the same name gives way.
        families: of effects that may be there.

    Returns:
        The effect; None where nothing is certain.
    """
    ranked = _ranked(problem.project(joint), families)
    names = list(dict.fromkeys(str(h.choice) for h in ranked))[:_COMPARED]
    best = _fitted(problem, joint, ranked)
    if best is None:
        return None
    ranked = _ranked(problem.project(best.joint, without_last=True), families, names)
    own = str(best.joint.choices[-1])
    if str(ranked[0].choice) != own:
        best = _fitted(problem, joint, ranked)
        if best is None or str(best.joint.choices[-1]) != own:
            return None
    posterior = sum(
        math.exp(h.log_odds - logsumexp([h.log_odds for h in ranked])) for h in ranked if str(h.choice) == own
    )
    without = max([0.0, *(h.log_odds for h in ranked if h.choice.regime is None)])
    is_certain = min(posterior, best.posterior) > _POSTERIOR and ranked[0].log_odds - without > _BETTER
    is_physical = not best.joint.beyond(len(best.joint.choices) - 1)
    return EffectInRegime(best.joint.choices[-1], posterior) if is_certain and is_physical else None


@dataclass(frozen=True)
class _Fitted:
    """A fit whose last effect acts in a part of the data.

    Attributes:
        joint: the fit.
        posterior: probability of the part's variable and side, given the effect.
    """

    joint: JointFit
    posterior: float


def _fitted(problem: Problem, joint: JointFit, ranked: Sequence[_Hypothesis]) -> _Fitted | None:
    """Return the best fit with one of the effects that promise most in addition; None if none has a regime.

    What is near in the noise that the kinematics alone leave may be far apart in the noise that the true effect leaves.
    """
    by_name: dict[str, _Hypothesis] = {}
    for h in ranked:
        if h.choice.regime is not None and h.log_odds > _BETTER:
            by_name.setdefault(str(h.choice), h)
    found = None
    for h in list(by_name.values())[:_FITTED]:
        others = [c for c in joint.choices if str(c) != str(h.choice)]
        tried = _in_best_part(problem, problem.fit([*others, h.choice], joint.start(others)))
        if found is None or tried.joint.fit.cost < found.joint.fit.cost:
            found = tried
    return found


def _in_best_part(problem: Problem, joint: JointFit) -> _Fitted:
    """Return a fit with the part of its last effect in which the errors are least, of those by any variable.

    A row on the wrong side of a border looks like an outlier, which has no say in a fit.
    """
    for _ in range(_PASSES):
        part, posterior = _best_part(problem, joint)
        choice = joint.choices[-1]
        if part == choice.regime:
            break
        joint = problem.fit([*joint.choices[:-1], replace(choice, regime=part)], joint.fit.x)
    return _Fitted(joint, posterior)


def _best_part(problem: Problem, joint: JointFit) -> tuple[Regime, float]:
    """Return where a fit's last effect leaves the least errors, and the probability of that variable and side."""
    choice, own = joint.choices[-1], joint.slice_of(len(joint.choices) - 1)
    assert choice.regime is not None
    samples, context = problem.solution.samples, joint.situation
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
        border, order = _borders(values, len(values)), np.argsort(values)
        count = np.searchsorted(values[order], border)
        gain = np.concatenate([[0.0], np.cumsum((outside - within)[order])])
        for above, cost in ((True, gain[count]), (False, -gain[count])):
            # Those up to a border are outside of a part above it.
            total = cost + (within if above else outside).sum()
            best = int(total.argmin())
            found.append((float(total[best]), Regime(variable, above, float(border[best]))))
    least, part = min(found, key=lambda f: f[0])
    return part, 1.0 / float(np.exp([least - total for total, _ in found]).sum())


def _ranked(projection: Projection, families: Collection[str], names: Collection[str] = ()) -> list[_Hypothesis]:
    """Return the hypotheses that promise most, the most probable first, and every candidate in all rows.

    Args:
        projection: about a fit.
        families: of the candidates.
        names: `family@where` of those that are compared; all of the families by default, with fewer borders.
    """
    every = candidate_effects(projection.situation, projection, families).candidates
    few = [c for c in every if len(set(c.first_equal)) <= _MOST_FORMS and (not names or str(c) in names)]
    everywhere = np.zeros(len(projection.samples), dtype=np.intp)
    whole = [
        _best(candidate, values[:, :, 0], [None], candidate.log_prior)
        for candidate, values in zip(few, _Columns(projection, few).evidence(0, everywhere), strict=True)
    ]
    values = {name: projection.samples.average(v[:, None])[:, 0] for name, v in variables(projection.situation).items()}
    log_prior = _REGIME - math.log(2.0 * max(len(values), 1))
    columns = _Columns(projection, few, _LIKELY)
    coarse = sorted(_in_parts(columns, values, _COARSE, log_prior), key=lambda h: -h.log_odds)
    # Those that promise most, and the best of every candidate.
    coarse = [*coarse[:_COMPARED], *{str(h.choice): h for h in reversed(coarse)}.values()]
    fine = []
    for variable in {h.choice.regime.variable for h in coarse if h.choice.regime}:
        own = {str(h.choice) for h in coarse if h.choice.regime and h.choice.regime.variable == variable}
        columns = _Columns(projection, [c for c in few if str(c) in own])
        fine += list(_in_parts(columns, {variable: values[variable]}, _FINEST if names else _FINE, log_prior))
    return sorted([*whole, *fine], key=lambda h: -h.log_odds)


def _in_parts(columns: _Columns, values: Mapping[str, Floats], borders: int, log_prior: float) -> Iterator[_Hypothesis]:
    """Yield every candidate on either side of each variable (m,), its border averaged over so many."""
    for variable, own in values.items():
        border = _borders(own, borders)
        if not len(border):
            continue
        slice_of = np.searchsorted(border, np.where(np.isfinite(own), own, -math.inf))
        for candidate, evidence in zip(columns.candidates, columns.evidence(len(border), slice_of), strict=True):
            for above in (False, True):
                regimes: list[Regime | None] = [Regime(variable, above, float(value)) for value in border]
                yield _best(candidate, evidence[:, :, int(above)], regimes, candidate.log_prior + log_prior)


def _best(
    candidate: CandidateEffect, values: Floats, regimes: Sequence[Regime | None], log_prior: float
) -> _Hypothesis:
    """Return a candidate by its log evidence (options, borders, scales), averaged over borders that are as likely."""
    most = float(values.max())
    together = most + math.log(float(np.exp(values - most).sum()) / len(regimes))
    option, at, scale = np.unravel_index(int(values.argmax()), values.shape)
    choice = replace(candidate.options[option], scale=SCALES[scale], regime=regimes[at])
    return _Hypothesis(choice, together, together + log_prior)


def _borders(values: Floats, count: int) -> Floats:
    """Return at most so many borders between values (m,), halfway between neighbours and evenly in their order."""
    known = np.sort(values[np.isfinite(values)])
    at = np.unique((np.linspace(_LEAST, 1.0 - _LEAST, count) * len(known)).astype(int))
    distinct = np.unique(known)
    place = np.unique(np.searchsorted(distinct, known[at[at < len(known)]]))
    border = (distinct[place[place > 0]] + distinct[place[place > 0] - 1]) / 2.0
    share = np.searchsorted(known, border) / max(len(known), 1)
    found: Floats = border[(share >= _LEAST) & (share <= 1.0 - _LEAST)]
    return found


class _Columns:
    """Whitened columns of candidates, and their evidence in all samples of a projection and in parts of them.

    Args:
        projection: about a fit.
        candidates: effects.
        scales: of plausible sizes that are compared.
    """

    def __init__(
        self, projection: Projection, candidates: Sequence[CandidateEffect], scales: Sequence[float] = SCALES
    ) -> None:
        self._projection, self.candidates, self._scales = projection, candidates, scales
        self._of: dict[int, list[tuple[int, int]]] = {}  # number of columns -> candidates with their options
        for number, candidate in enumerate(candidates):
            for option, additions in enumerate(candidate.additions):
                self._of.setdefault(len(additions), []).append((number, option))
        self._rows = {}
        for width, options in self._of.items():
            moved = (projection.moved_mm(candidates[n].additions[o]) for n, o in options)
            self._rows[width] = np.hstack([projection.whitened(own) for own in moved])
        self._removed_target = projection.without_kinematics.removed(projection.target)

    def evidence(self, borders: int, slice_of: Integers) -> list[Floats]:
        """Return for each candidate (options, borders, 2, scales) log evidence with the prior odds of form and size.

        Args:
            borders: number of borders, of which samples of slice i are above the first i.
            slice_of: (m,) of each sample.

        Returns:
            For the samples that are not above a border, and for those that are.
        """
        index = [rows_of(np.flatnonzero(slice_of == number)) for number in range(borders + 1)]
        log_scale_odds = np.array([LOG_SCALE_ODDS[scale] for scale in self._scales])
        found: list[list[Floats]] = [[] for _ in self.candidates]
        for width, options in self._of.items():
            sigma = np.array([self.candidates[n].additions[o].prior_sigma for n, o in options])
            gram, along = self._products(self._rows[width], width, index)
            values = _log_bayes_factors(gram, along, sigma[:, None, None], self._scales) + log_scale_odds
            for (number, option), own in zip(options, values, strict=True):
                found[number].append(own + self.candidates[number].log_odds[option])
        return [np.array(own) for own in found]

    def _products(self, columns: Floats, width: int, index: Sequence[Integers]) -> tuple[Floats, Floats]:
        """Return products (o, b, 2, k, k) of blocks of projected columns, and with the target (o, b, 2, k).

        Args:
            columns: (3 m, o k) of o blocks.
            width: k.
            index: rows of each of b + 1 slices.
        """
        over = self._projection
        with_kinematics, with_target, grams = [], [], []
        for rows in index:
            own = columns[rows]
            with_kinematics.append(over.kinematics[rows].T @ own)
            with_target.append(over.target[rows] @ own)
            blocks = np.ascontiguousarray(own.reshape(len(own), -1, width).swapaxes(0, 1))
            grams.append(blocks.swapaxes(1, 2) @ blocks)
        removed = over.without_kinematics.removed_by(_on_both_sides(with_kinematics))
        along = _on_both_sides(with_target) - np.einsum("...qk,q->...k", removed, self._removed_target)
        removed = np.moveaxis(removed.reshape(*removed.shape[:3], -1, width), 3, 0)
        gram = np.moveaxis(_on_both_sides(grams), 2, 0) - removed.swapaxes(-1, -2) @ removed
        return gram, np.moveaxis(along.reshape(*along.shape[:2], -1, width), 2, 0)


def _on_both_sides(slices: Sequence[Floats]) -> Floats:
    """Return (b, 2, ...) sums below and above each of b borders, from those of the b + 1 slices between them.

    Without a border they are those of all samples, and of none.
    """
    sums = np.array(slices)
    total = sums.sum(axis=0)
    below = np.cumsum(sums, axis=0)[:-1] if len(sums) > 1 else total[None]
    return np.stack([below, total - below], axis=1)


def _log_bayes_factors(gram: Floats, along: Floats, sigma: Floats, scales: Sequence[float]) -> Floats:
    """Return (..., s) log Bayes factors at s scales, as `from_products`, of (..., k, k), (..., k) and (..., k)."""
    out = []
    for scale in scales:
        unit = sigma * scale
        factor = np.linalg.cholesky(gram * unit[..., None] * unit[..., None, :] + np.eye(gram.shape[-1]))
        solved = np.linalg.solve(factor, (along * unit)[..., None])[..., 0]
        log_root = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
        out.append(0.5 * (solved**2).sum(axis=-1) - log_root)
    return np.stack(out, axis=-1)
