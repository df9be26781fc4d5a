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

_COARSE, _FINE = 6, 24  # borders of a variable, for all hypotheses and for those that promise most
_COMPARED = 40  # hypotheses
_LEAST = 0.1  # share of the samples on either side of a border
_MOST_FORMS = 40  # of a candidate: one with more is a step at any time
_FITTED = 4  # hypotheses that are fitted to see how large the noise is
_REGIME = math.log(0.1)  # prior probability that an effect acts in a part only
_POSTERIOR = 0.95  # of an effect and its variable, among all
_BETTER = math.log(999.0)  # log odds against all rows
_LOG_ODDS = np.array([LOG_SCALE_ODDS[scale] for scale in SCALES])


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

    @property
    def name(self) -> tuple[str, str, str, bool]:
        """Effect, place, variable and side."""
        own = self.choice.regime
        return self.choice.family, self.choice.where, "" if own is None else own.variable, own is not None and own.above


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
        joint: kinematics and effects that are there; one of the same name gives way.
        families: of effects that may be there.

    Returns:
        The effect; None where nothing is certain.
    """
    ranked = _ranked(problem.project_with_mild_outliers(joint), families)
    names = {str(h.choice) for h in ranked[:_COMPARED]}
    for _ in range(_FITTED):
        best = ranked[0]
        if best.choice.regime is None or best.log_odds < _BETTER:
            return None
        others = [c for c in joint.choices if str(c) != str(best.choice)]
        found = problem.fit([*others, best.choice], joint.start(others))
        ranked = _ranked(problem.project(found, without_last=True), families, names)
        if ranked[0].name == best.name:
            break
    else:
        return None
    if ranked[0].choice != best.choice:
        found = problem.fit([*others, ranked[0].choice], found.fit.x)
    posterior = math.exp(ranked[0].log_odds - logsumexp([h.log_odds for h in ranked]))
    without = max([0.0, *(h.log_odds for h in ranked if h.choice.regime is None)])
    is_certain = posterior > _POSTERIOR and ranked[0].log_odds - without > _BETTER
    is_physical = not found.beyond(len(found.choices) - 1)
    return EffectInRegime(found.choices[-1], posterior) if is_certain and is_physical else None


def _ranked(
    projection: Projection, families: Collection[str], names: Collection[str] | None = None
) -> list[_Hypothesis]:
    """Return the hypotheses that promise most, the most probable first, and every candidate in all rows.

    Args:
        projection: about a fit.
        families: of the candidates.
        names: `family@where` of those that are compared; all of the families by default.
    """
    every = candidate_effects(projection.situation, projection, families).candidates
    few = [c for c in every if len(set(c.first_equal)) <= _MOST_FORMS and (names is None or str(c) in names)]
    everywhere = np.zeros(len(projection.samples), dtype=np.intp)
    whole = [
        _best(candidate, values[:, :, 0], [None], candidate.log_prior)
        for candidate, values in zip(few, _Columns(projection, few).evidence(0, everywhere), strict=True)
    ]
    values = {name: projection.samples.average(v[:, None])[:, 0] for name, v in variables(projection.situation).items()}
    log_prior = _REGIME - math.log(2.0 * max(len(values), 1))
    coarse = sorted(_in_parts(projection, few, values, _COARSE, log_prior), key=lambda h: -h.log_odds)[:_COMPARED]
    fine = []
    for variable in {h.choice.regime.variable for h in coarse if h.choice.regime}:
        own = {str(h.choice) for h in coarse if h.choice.regime and h.choice.regime.variable == variable}
        candidates = [c for c in few if str(c) in own]
        fine += list(_in_parts(projection, candidates, {variable: values[variable]}, _FINE, log_prior))
    return sorted([*whole, *fine], key=lambda h: -h.log_odds)


def _in_parts(
    projection: Projection,
    candidates: Sequence[CandidateEffect],
    values: Mapping[str, Floats],
    borders: int,
    log_prior: float,
) -> Iterator[_Hypothesis]:
    """Yield every candidate on either side of each variable (m,), its border averaged over so many."""
    columns = _Columns(projection, candidates)
    for variable, own in values.items():
        border = _borders(own, borders)
        if not len(border):
            continue
        slice_of = np.searchsorted(border, np.where(np.isfinite(own), own, -math.inf))
        for candidate, evidence in zip(candidates, columns.evidence(len(border), slice_of), strict=True):
            for above in (False, True):
                regimes = [Regime(variable, above, float(value)) for value in border]
                yield _best(candidate, evidence[:, :, int(above)], regimes, candidate.log_prior + log_prior)


def _best(
    candidate: CandidateEffect, values: Floats, regimes: Sequence[Regime | None], log_prior: float
) -> _Hypothesis:
    """Return a candidate by its log evidence (options, borders, scales), averaged over borders that are as likely."""
    together = float(logsumexp(values)) - math.log(len(regimes))
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
    """Whitened columns of candidates, and their evidence in all samples of a projection and in parts of them."""

    def __init__(self, projection: Projection, candidates: Sequence[CandidateEffect]) -> None:
        self._projection, self._candidates = projection, candidates
        self._slice: dict[tuple[int, int], slice] = {}
        parts, count = [], 0
        for number, candidate in enumerate(candidates):
            for option, first in enumerate(candidate.first_equal):
                if option == first:
                    parts.append(candidate.additions[option])
                    self._slice[number, option] = slice(count, count := count + len(parts[-1]))
                self._slice[number, option] = self._slice[number, first]
        self._rows = np.hstack([projection.whitened(projection.moved_mm(part)) for part in parts])
        self._removed_target = projection.without_kinematics.removed(projection.target)

    def evidence(self, borders: int, slice_of: Integers) -> list[Floats]:
        """Return for each candidate (options, borders, 2, scales) log evidence with the prior odds of form and size.

        Args:
            borders: number of borders, of which samples of slice i are above the first i.
            slice_of: (m,) of each sample.

        Returns:
            For the samples that are not above a border, and for those that are.
        """
        projection, blocks = self._projection, set(map(_ends, self._slice.values()))
        with_kinematics = np.empty((borders + 1, projection.kinematics.shape[1], self._rows.shape[1]))
        with_target = np.empty((borders + 1, self._rows.shape[1]))
        grams = {ends: np.empty((borders + 1, ends[1] - ends[0], ends[1] - ends[0])) for ends in blocks}
        for number in range(borders + 1):
            index = rows_of(np.flatnonzero(slice_of == number))
            rows = self._rows[index]
            with_kinematics[number] = projection.kinematics[index].T @ rows
            with_target[number] = projection.target[index] @ rows
            for (a, b), gram in grams.items():
                gram[number] = rows[:, a:b].T @ rows[:, a:b]
        removed = projection.without_kinematics.removed_by(_on_both_sides(with_kinematics))
        along = _on_both_sides(with_target) - np.einsum("...qk,q->...k", removed, self._removed_target)
        products = {
            (a, b): _on_both_sides(gram) - removed[..., a:b].swapaxes(-1, -2) @ removed[..., a:b]
            for (a, b), gram in grams.items()
        }
        return [
            np.array(
                [
                    _evidence(products[_ends(own)], along[..., own], candidate.additions[option].prior_sigma) + log_odds
                    for option, log_odds in enumerate(candidate.log_odds)
                    for own in [self._slice[number, option]]
                ]
            )
            for number, candidate in enumerate(self._candidates)
        ]


def _ends(columns: slice) -> tuple[int, int]:
    return columns.start, columns.stop


def _on_both_sides(sums: Floats) -> Floats:
    """Return (b, 2, ...) sums below and above each of b borders, from those of the slices (b + 1, ...) between them.

    Without a border they are those of all samples.
    """
    total = sums.sum(axis=0)
    below = np.cumsum(sums, axis=0)[:-1] if len(sums) > 1 else total[None]
    return np.stack([below, total - below], axis=1)


def _evidence(gram: Floats, along: Floats, sigma: Floats) -> Floats:
    """Return (..., scales) log Bayes factors and prior odds, from products (..., k, k) and (..., k)."""
    size, axes = np.linalg.eigh(gram * sigma * sigma[:, None])
    size = np.maximum(size, 0.0)[..., None, :] * np.square(SCALES)[:, None]
    squares = np.einsum("...kj,...k->...j", axes, along * sigma)[..., None, :] ** 2 * np.square(SCALES)[:, None]
    values: Floats = 0.5 * (squares / (1.0 + size) - np.log1p(size)).sum(axis=-1) + _LOG_ODDS
    return values
