"""Forecasts: how visible every effect would be in these data, whether it exists or not.

Calibration hides effects: a refit of the kinematics absorbs most of an effect's displacements, and a different effect
may imitate the rest. Both follow from the poses alone. Let G (r, k) be the displacements by one prior sigma of each
coefficient in the projected space, and c the coefficients of a true effect. The expected log Bayes factor of a
candidate H with H'H = V diag(l) V' and orthonormal basis U of its columns is

    1/2 sum_i (|U_i' G c|^2 + 1) l_i / (1 + l_i) - 1/2 sum_i ln(1 + l_i).

The size of c at which the effect stands out from no effect and from every alternative therefore has a closed form. A
curve that is flexible enough to imitate anything is not an alternative, as its evidence is penalised for this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.effects.base import Coefficient, FittedCoefficient
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.gap.projected.projection import Integers
from calibration.gap.result import Forecast
from calibration.gap.screening import Screen
from calibration.observations import Floats

_NAMED = 5.0  # log Bayes factor required against no effect and against any alternative
_SURE = math.log(0.95 / 0.05)  # log odds required, including the prior
_FREE = 4  # variants of other effects with more coefficients are not alternatives
_SEEN = 1e-9  # smallest eigenvalue that counts as visible, relative to the largest


@dataclass(frozen=True)
class _Variant:
    """One variant of a candidate, as a model to fit.

    Attributes:
        candidate: index of the candidate.
        basis: (r, k) orthonormal basis of the variant's columns.
        kept: (k,) l / (1 + l): share of a residual along the basis that the variant explains under its prior.
        chance: expected log Bayes factor for noise alone.
    """

    candidate: int
    basis: Floats
    kept: Floats
    chance: float


@dataclass(frozen=True)
class _Shown:
    """A candidate as the true effect, in its most visible variant.

    Attributes:
        option: index of this variant in the candidate.
        leading: the first coefficient.
        main: (r, k) projected displacements by one prior sigma of each coefficient, without shape coefficients.
        visible: RMS share of the displacements that the kinematics cannot absorb.
        visible_mm: RMS of this part.
    """

    option: int
    leading: Coefficient
    main: Floats
    visible: float
    visible_mm: float


def forecasts(screen: Screen) -> tuple[Forecast, ...]:
    """Return one forecast for each candidate of a screen, in order."""
    variants: list[_Variant] = []
    shown: list[_Shown] = []
    own: list[int] = []
    for number, candidate in enumerate(screen.candidates):
        first = len(variants)
        options = _distinct(screen, number)
        truth = _truth(screen, number, options)
        options = [o for o in options if o == truth.option or len(candidate.additions[o]) <= _FREE]
        variants += [
            _variant(number, screen.columns(number, option) * candidate.additions[option].prior_sigma)
            for option in options
        ]
        shown.append(truth)
        own.append(first + options.index(truth.option))
    if not variants:
        return ()
    alternatives = _Alternatives(variants, [screen.candidates[v.candidate].family for v in variants])
    explained, evidence = alternatives.of([truth.main for truth in shown])
    return tuple(
        _forecast(screen, number, truth, alternatives, own[number], explained[number], evidence[number])
        for number, truth in enumerate(shown)
    )


class _Alternatives:
    """All variants as models to fit, for many true effects at once.

    Args:
        variants: v variants.
        families: family of each variant.

    Attributes:
        variants: as above.
        chance: (v,) expected log Bayes factors for noise alone.
    """

    def __init__(self, variants: list[_Variant], families: list[str]) -> None:
        self.variants = variants
        self.chance = np.array([v.chance for v in variants])
        self._family = np.array(families)
        self._is_alternative = np.array([v.basis.shape[1] <= _FREE for v in variants])

    def against(self, family: str) -> Integers:
        """Return the indices of variants of other families that are not too flexible."""
        return np.flatnonzero(self._is_alternative & (self._family != family))

    def of(self, truths: list[Floats]) -> tuple[Floats, Floats]:
        """Return how well every variant imitates each of t true effects (r, k) with equal coefficients.

        Returns:
            (t, v) the part of a true effect's squares that each variant can explain, and (t, v) the increase of the
            variant's expected log Bayes factor per squared size of the true effect.
        """
        basis, kept = np.hstack([v.basis for v in self.variants]), np.concatenate([v.kept for v in self.variants])
        begin = np.cumsum([0, *(v.basis.shape[1] for v in self.variants)])[:-1]
        first = np.cumsum([0, *(truth.shape[1] for truth in truths)])[:-1]
        along = np.add.reduceat((np.hstack(truths).T @ basis) ** 2, first, axis=0)
        along /= np.array([truth.shape[1] for truth in truths])[:, None]
        return np.add.reduceat(along, begin, axis=1), 0.5 * np.add.reduceat(along * kept, begin, axis=1)


def _forecast(
    screen: Screen,
    number: int,
    truth: _Shown,
    alternatives: _Alternatives,
    own: int,
    explained: Floats,
    evidence: Floats,
) -> Forecast:
    candidate = screen.candidates[number]
    others = alternatives.against(candidate.family)
    value = truth.leading.sigma * _least_size(own, others, evidence, alternatives.chance, candidate.log_prior)
    alternative, separation = "", 1.0
    if len(others) > 0:
        total = float((truth.main**2).sum()) / truth.main.shape[1]
        closest = int(others[np.argmax(explained[others])])
        alternative = str(screen.candidates[alternatives.variants[closest].candidate])
        separation = math.sqrt(max(0.0, 1.0 - float(explained[closest]) / total)) if total > 0.0 else 0.0
    return Forecast(
        candidate.family,
        candidate.where,
        truth.leading.unit,
        truth.visible,
        truth.visible_mm,
        value if value <= max(-truth.leading.lower, truth.leading.upper) else math.inf,
        alternative,
        separation,
    )


def _least_size(own: int, others: Integers, evidence: Floats, chance: Floats, log_prior: float) -> float:
    """Return the smallest size of an effect, in prior sigmas with equal coefficients, at which it is named.

    Args:
        own: index of the effect's variant.
        others: indices of the alternatives' variants.
        evidence: (v,) increase of the expected log Bayes factor of each variant per squared size of the effect.
        chance: (v,) expected log Bayes factors for noise alone.
        log_prior: log prior probability of the effect.
    """
    wanted = [max(_NAMED, _SURE - log_prior) - chance[own], *(_NAMED - chance[own] + chance[others])]
    gained = [evidence[own], *(evidence[own] - evidence[others])]
    squares = [
        max(w, 0.0) / g if g > 0.0 else (math.inf if w > 0.0 else 0.0) for w, g in zip(wanted, gained, strict=True)
    ]
    return math.sqrt(max(squares))


def _distinct(screen: Screen, candidate: int) -> list[int]:
    """Return the variants with distinct columns; of variants that differ only in the prior, the one with the widest."""
    sigma = [additions.prior_sigma.sum() for additions in screen.candidates[candidate].additions]
    return [max(same, key=sigma.__getitem__) for same in screen.distinct(candidate)]


def _variant(candidate: int, columns: Floats) -> _Variant:
    value, vector = np.linalg.eigh(columns.T @ columns)
    if not value[-1] > 0.0:  # nothing of the variant is left after projection: it explains nothing
        return _Variant(candidate, np.zeros((len(columns), 1)), np.zeros(1), 0.0)
    seen = value > _SEEN * value[-1]
    value, vector = value[seen], vector[:, seen]
    kept = value / (1.0 + value)
    return _Variant(candidate, columns @ (vector / np.sqrt(value)), kept, 0.5 * float((kept - np.log1p(value)).sum()))


def _truth(screen: Screen, number: int, options: list[int]) -> _Shown:
    """Return the most visible variant among those with the same coefficients as the first."""
    candidate, projection = screen.candidates[number], screen.projection
    names = candidate.additions[options[0]].names
    best: tuple[float, int, Floats, list[int], tuple[Coefficient, ...]] | None = None
    for option in options:
        if candidate.additions[option].names != names:
            continue
        coefficients = _coefficients(screen, candidate.options[option])
        main = _leading(candidate.options[option], coefficients)
        sigma = candidate.additions[option].prior_sigma[main]
        moved = screen.columns(number, option)[:, main] * sigma
        power = float((moved**2).sum())
        if best is None or power > best[0]:
            best = power, option, moved, main, coefficients
    assert best is not None  # the first variant always qualifies
    power, option, moved, main, coefficients = best
    additions = candidate.additions[option]
    raw_mm = projection.moved_mm(additions)[:, :, main] * additions.prior_sigma[main]
    whole = float((projection.whitened(raw_mm) ** 2).sum())
    visible = math.sqrt(power / whole) if whole > 0.0 else 0.0
    raw = math.sqrt(float((raw_mm**2).sum()) / (len(raw_mm) * len(main)))
    return _Shown(option, coefficients[main[0]], moved, visible, visible * raw)


def _coefficients(screen: Screen, choice: Choice) -> tuple[Coefficient, ...]:
    return library()[choice.family].coefficients(screen.projection.context, choice.where, choice.settings)


def _leading(choice: Choice, coefficients: tuple[Coefficient, ...]) -> list[int]:
    """Return the indices of the coefficients that outputs report; all if the outputs report other numbers."""
    fitted = tuple(FittedCoefficient(c.name, c.unit, 0.0, 0.0, c.sigma) for c in coefficients)
    listed = {c.name for c in library()[choice.family].reported(choice.settings, fitted)}
    found = [i for i, c in enumerate(coefficients) if c.name in listed]
    return found or list(range(len(coefficients)))
