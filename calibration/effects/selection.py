"""Which effects the data ask for: log evidence of the linearised fit, confirmed by grouped cross-validation.

Kinematics and effects are correlated (a fit of the kinematics alone absorbs most of a deflection), so every comparison
has both in it, each with its prior. About the fitted kinematics the model is linear and normal,

    y = J x + C c + noise,  x ~ N(0, P),  c ~ N(0, S),  noise ~ N(0, known + s^2 I),

and its log evidence is in closed form (Rasmussen and Williams 2006, Eq. 2.30). s^2 is taken anew for every set of
effects: what one of them explains is noise to the others until it is in.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from calibration.identification.additions import Additions
from calibration.identification.refinement import Fit, prior_precision
from calibration.identification.samples import Samples, reading_covariance
from calibration.kinematics import Chain
from calibration.observations import Floats
from calibration.residual.folds import folds

Labels = NDArray[np.str_]
Odds = Sequence[Sequence[float]]

NO_GAIN = "none lowers the error of held-out groups beyond chance"

_LOCATION_ODDS = math.log(9.0)  # one place in ten has the effect
_DECISIVE = math.log(99.0)  # odds for all that is adopted together
_STEP = 0.5  # smallest gain of log evidence that is worth another step
_STEPS = 60
_EXCESS_RANGE = (-14.0, 3.0)  # log of s^2 over the variance of the errors
_EXCESS_STEP = 0.05
_LEAST_SCALE = 1e-12  # mm^2
_FOLDS = 10
_CHANCE = 0.01


@dataclass(frozen=True)
class Posterior:
    """Of one set of effects, given the noise.

    Attributes:
        evidence: log evidence up to a constant.
        x: (p + k,) mean, in prior sigmas.
    """

    evidence: float
    x: Floats


@dataclass(frozen=True)
class Alternative:
    """One variant of an effect.

    Attributes:
        moved: (3 m, k) what a unit of each coefficient moves, along the axes of the noise; one array for variants that
            differ in their prior alone.
        sigma: (k,) prior of the coefficients.
    """

    moved: Floats
    sigma: Floats

    @property
    def columns(self) -> Floats:
        """(3 m, k) what one prior sigma of each coefficient moves."""
        return self.moved * self.sigma


class LinearFit:
    """The fit linearised about the kinematics alone.

    Args:
        chain, samples, fit: the kinematics, what they were fitted to, and the fit (p parameters).
        weight: probability that a sample is no outlier.
        rows: (m,) which samples take part.
    """

    def __init__(self, chain: Chain, samples: Samples, fit: Fit, weight: Floats, rows: NDArray[np.intp]) -> None:
        weight = weight[rows]
        lin = chain.linearise(fit.x, samples.data.select(rows))
        known = samples.station_covariance[rows]
        known = known + reading_covariance(chain.rig, lin.joint_jacobian, samples.rates[rows])
        variance, axes = np.linalg.eigh(known)
        self._turn = axes.transpose(0, 2, 1)  # along whose axes the noise is independent whatever s^2 is
        self._joint_jacobian = lin.joint_jacobian
        sigma = 1.0 / np.sqrt(prior_precision(chain, fit.prior_scale))
        self._sigma = sigma
        self.kinematics = self._turned(lin.jacobian * sigma)
        error = samples.position_mm[rows] - lin.position_mm
        self.target = self._turned((error + lin.jacobian @ fit.x)[:, :, None])[:, 0]
        self._variance = variance.ravel()
        self._weight = np.repeat(weight, 3)
        self._scale = max(float(weight @ (error**2).sum(axis=1) / (3.0 * len(weight))), _LEAST_SCALE)

    def alternatives(self, variants: Sequence[Additions]) -> tuple[Alternative, ...]:
        """What the coefficients of every variant of an effect move."""
        found: list[Alternative] = []
        for number, own in enumerate(variants):
            same = (
                a.moved for a, v in zip(found, variants[:number], strict=True) if np.array_equal(v.column, own.column)
            )
            moved = next(same, None)
            if moved is None:
                moved = self._turned(own.moved_mm(self._joint_jacobian))
            found.append(Alternative(moved, own.prior_sigma))
        return tuple(found)

    def solve(self, additions: Additions) -> Floats:
        """(p + k,) parameters and coefficients."""
        (only,) = self.alternatives([additions])
        columns = only.columns
        x = self.posterior(columns, self.best_excess(columns)).x
        solved: Floats = x * np.concatenate([self._sigma, additions.prior_sigma])
        return solved

    def precision(self, excess: float) -> Floats:
        """(3 m,) inverse variance of the noise, outliers weighted out."""
        precision: Floats = self._weight / (self._variance + excess)
        return precision

    def posterior(self, columns: Floats, excess: float) -> Posterior:
        """Posterior of kinematics and the given effects."""
        precision = self.precision(excess)
        design = np.hstack([self.kinematics, columns])
        weighted = design * precision[:, None]
        gram, right = design.T @ weighted, weighted.T @ self.target
        return self.solved(gram, right, self.constant(excess))

    def constant(self, excess: float) -> float:
        """Share of the log evidence that no effect changes."""
        precision = self.precision(excess)
        return -0.5 * float(self._weight @ np.log(self._variance + excess) + precision @ self.target**2)

    @staticmethod
    def solved(gram: Floats, right: Floats, constant: float) -> Posterior:
        """Posterior from the normal equations in prior sigmas, the priors not yet in them.

        No evidence at all where the noise is so small beside the priors that rounding takes over.
        """
        try:
            factor = cho_factor(gram + np.eye(len(gram)), lower=True)
        except LinAlgError:
            return Posterior(-math.inf, np.zeros(len(gram)))
        x = cho_solve(factor, right)
        evidence = constant + 0.5 * float(right @ x) - float(np.log(np.diag(factor[0])).sum())
        return Posterior(evidence, x)

    def best_excess(self, columns: Floats) -> float:
        """s^2 of the greatest evidence."""
        low, high = (math.log(self._scale) + end for end in _EXCESS_RANGE)
        found = minimize_scalar(
            lambda log: -self.posterior(columns, math.exp(log)).evidence,
            bounds=(low, high),
            method="bounded",
            options={"xatol": _EXCESS_STEP},
        )
        return math.exp(float(found.x))

    def options(self, alternatives: Sequence[Sequence[Alternative]], odds: Odds, excess: float) -> _Options:
        """All evidences at one s^2 from a single product of all columns."""
        parts = {id(self.kinematics): self.kinematics}
        parts |= {id(option.moved): option.moved for options in alternatives for option in options}
        ends = np.cumsum([0, *(part.shape[1] for part in parts.values())]).tolist()
        index = {key: np.arange(*span) for key, span in zip(parts, itertools.pairwise(ends), strict=True)}
        design = np.hstack(list(parts.values()))
        weighted = design * self.precision(excess)[:, None]
        kinematics = index[id(self.kinematics)]
        return _Options(
            design.T @ weighted,
            weighted.T @ self.target,
            self.constant(excess),
            (kinematics, np.ones(len(kinematics))),
            [[(index[id(option.moved)], option.sigma) for option in options] for options in alternatives],
            odds,
        )

    def held_out(self, columns: Floats, excess: float, fold: NDArray[np.intp]) -> Floats:
        """(m,) squared error of every row, mm^2, times its weight, by fits without the rows of its `fold` (m,)."""
        precision = self.precision(excess)
        design = np.hstack([self.kinematics, columns])
        weighted = design * precision[:, None]
        whole, right = design.T @ weighted, weighted.T @ self.target
        squares = np.empty(len(fold))
        for number in np.unique(fold):
            rows = np.repeat(fold == number, 3)
            own = design[rows].T @ weighted[rows]
            left = right - weighted[rows].T @ self.target[rows]
            x = self.solved(whole - own, left, 0.0).x
            error = self.target[rows] - design[rows] @ x
            squares[fold == number] = (self._weight[rows] * error**2).reshape(-1, 3).sum(axis=1)
        return squares

    def _turned(self, vectors: Floats) -> Floats:
        """(3 m, k) rows (m, 3, k) along the axes of the noise."""
        turned: Floats = (self._turn @ vectors).reshape(3 * len(vectors), vectors.shape[2])
        return turned


@dataclass(frozen=True)
class _Options:
    gram: Floats
    right: Floats
    constant: float
    kinematics: tuple[NDArray[np.intp], Floats]
    indices: Sequence[Sequence[tuple[NDArray[np.intp], Floats]]]
    odds: Odds

    def evidence(self, chosen: Sequence[int | None]) -> float:
        """Log evidence with the chosen alternative of every place, None for none, less the odds of the choice."""
        parts = [self.indices[place][option] for place, option in enumerate(chosen) if option is not None]
        index = np.concatenate([self.kinematics[0], *(part[0] for part in parts)])
        sigma = np.concatenate([self.kinematics[1], *(part[1] for part in parts)])
        gram, right = self.gram[np.ix_(index, index)] * sigma * sigma[:, None], self.right[index] * sigma
        return LinearFit.solved(gram, right, self.constant).evidence - _odds_against(chosen, self.odds)


def choose(
    fit: LinearFit, alternatives: Sequence[Sequence[Alternative]], odds: Odds, *, required: bool
) -> tuple[int | None, ...]:
    """The alternatives with the greatest evidence, found step by step, each step the best single change.

    Args:
        fit: the linearised fit.
        alternatives: per place every variant that may be there.
        odds: per place how plausible each of them is beside the others.
        required: every place has one of its variants; else it may have none.

    Returns:
        The chosen alternative of every place, None for none.
    """
    chosen: list[int | None] = [0 if required else None for _ in alternatives]
    for _ in range(_STEPS):
        options = fit.options(alternatives, odds, fit.best_excess(_taken(fit, alternatives, chosen)))
        here = options.evidence(chosen)
        best: tuple[float, list[int | None]] = (here + _STEP, chosen)
        for place, variants in enumerate(alternatives):
            for option in (*(() if required else (None,)), *range(len(variants))):
                changed = [*chosen[:place], option, *chosen[place + 1 :]]
                best = max(best, (options.evidence(changed), changed), key=lambda found: found[0])
        if best[1] == chosen:
            break
        chosen = best[1]
    return tuple(chosen)


def doubt(
    fit: LinearFit,
    alternatives: Sequence[Sequence[Alternative]],
    odds: Odds,
    chosen: Sequence[int | None],
    labels: Labels,
    seed: int,
) -> str | None:
    """Why a choice may be chance: odds of less than 99 to 1, or no lower errors on held-out groups.

    Args:
        fit, alternatives, odds, chosen: as `choose` takes and returns them.
        labels: (m,) groups that no fold separates.
        seed: of the folds.

    Returns:
        The reason, a clause; None if it is beyond chance.
    """
    columns = _taken(fit, alternatives, chosen)
    nothing = columns[:, :0]
    excess, without = fit.best_excess(columns), fit.best_excess(nothing)
    gain = fit.posterior(columns, excess).evidence - fit.posterior(nothing, without).evidence
    if not gain - _odds_against(chosen, odds) >= _DECISIVE:  # neither where it is not a number
        return "the data give no odds of 99 to 1 for one"
    fold = folds(labels, _FOLDS, seed)
    before, after = fit.held_out(nothing, without, fold), fit.held_out(columns, excess, fold)
    _, index, size = np.unique(labels, return_inverse=True, return_counts=True)
    lowered = np.bincount(index, before - after) / size
    # By ranks: single fixes far from all others, where neither fit knows anything, would decide about a mean.
    p = float(stats.wilcoxon(lowered, alternative="greater").pvalue) if np.any(lowered) else 1.0
    return None if p < _CHANCE else NO_GAIN


def _odds_against(chosen: Sequence[int | None], odds: Odds) -> float:
    """Log odds against a choice before the data are seen; the variants of an effect share those of its place."""
    taken = [(own[option], sum(own)) for option, own in zip(chosen, odds, strict=True) if option is not None]
    return sum(_LOCATION_ODDS - math.log(own / whole) for own, whole in taken)


def _taken(fit: LinearFit, alternatives: Sequence[Sequence[Alternative]], chosen: Sequence[int | None]) -> Floats:
    """(3 m, k) columns of the chosen alternatives."""
    parts = [alternatives[place][option].columns for place, option in enumerate(chosen) if option is not None]
    return np.hstack([np.empty((len(fit.target), 0)), *parts])
