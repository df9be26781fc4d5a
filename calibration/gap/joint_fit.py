"""Joint fits of kinematics and effects, and the data of a search that refits them again and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.columns import EffectColumns, joined, nearly_same
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.gap.projection import Projection
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations

OUTLIER = 0.5  # least probability of a sample to be no outlier
_GROSS = 8.0  # times the median error


@dataclass(frozen=True)
class JointFit:
    """Kinematics and effects refitted together.

    Attributes:
        situation: of the observations, at the parameters that give the effects their loads and lever arms.
        choices: the effects.
        parts: displacements of the samples by each of them.
        fit: of parameters (p,), then of what the solution has in addition, and last of the coefficients of the effects.
    """

    situation: EffectContext
    choices: tuple[Choice, ...]
    parts: tuple[EffectColumns, ...]
    fit: Fit

    @property
    def _first(self) -> int:
        """Index of the effects' first coefficient in the fit's parameters."""
        return len(self.fit.x) - sum(map(len, self.parts))

    @property
    def additions(self) -> EffectColumns | None:
        """Displacements by all coefficients; None where there are no effects."""
        return joined(self.parts, len(self.parts[0].column)) if self.parts else None

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """The effects as a model has them."""
        return tuple(c.fitted(self.situation, *self.coefficients(i)) for i, c in enumerate(self.choices))

    def slice_of(self, number: int) -> slice:
        """Return where the fit's parameters have the coefficients of one effect."""
        first = self._first + sum(len(part) for part in self.parts[:number])
        return slice(first, first + len(self.parts[number]))

    def coefficients(self, number: int) -> tuple[Floats, Floats]:
        """Return values and standard errors of the coefficients of one effect."""
        own = self.slice_of(number)
        return self.fit.x[own], np.sqrt(np.diag(self.fit.covariance)[own])

    def with_last(self, number: int) -> JointFit:
        """Return the same fit with one of its effects moved to the end."""
        order = [*(n for n in range(len(self.choices)) if n != number), number]
        own = np.concatenate([np.arange(self._first), *(np.r_[self.slice_of(n)] for n in order)])
        fit = replace(self.fit, x=self.fit.x[own], covariance=self.fit.covariance[np.ix_(own, own)])
        return JointFit(self.situation, tuple(self.choices[n] for n in order), tuple(self.parts[n] for n in order), fit)

    def start(self, choices: Sequence[Choice]) -> Floats:
        """Return (p + k,) the start of a fit of the given effects, all of which this one has."""
        coefficients = [self.coefficients(self.choices.index(choice))[0] for choice in choices]
        return np.concatenate([self.fit.x[: self._first], *coefficients])

    def error_mm(self, solution: Solution) -> Floats:
        """Return (m, 3) measured minus fitted positions of the samples of a solution of its chain, mm."""
        chain, data, additions = solution.chain, solution.samples.data, along(solution, self.parts)
        x, coefficients = self.fit.x[: len(chain)], self.fit.x[len(chain) :]
        left = solution.samples.position_mm
        if additions is not None:
            data, shift_mm = additions.apply(data, coefficients)
            left = left - shift_mm
        error: Floats = left - chain.positions_mm(x, data)
        return error

    def beyond(self, number: int) -> tuple[str, ...]:
        """Return names of one effect's coefficients that are beyond their hard limits by more than chance."""
        return self.choices[number].beyond(self.situation, *self.coefficients(number))


def joint_fit(
    solution: Solution, observations: Observations, choices: Sequence[Choice], prior: Prior, start: Floats | None = None
) -> JointFit:
    """Refit the kinematics with effects.

    Loads and lever arms depend on the kinematics: where these change an effect by more than a hundred-thousandth, a
    second fit has those of the first one's.

    Args:
        solution: of the kinematics, for its chain and samples.
        observations: n rows that the samples are of.
        choices: the effects.
        prior: of the solution.
        start: (p,) or more: parameters, and coefficients of the first effects; the solution's by default.
    """
    chain, samples = solution.chain, solution.samples
    x = solution.fit.x if start is None else start
    situation, parts = _parts(solution, observations, choices, x)
    fit = refine(chain, samples, x, prior=prior, additions=along(solution, parts))
    again = _parts(solution, observations, choices, fit.x)
    if not all(nearly_same(a, b) for a, b in zip(parts, again[1], strict=True)):
        situation, parts = again
        fit = refine(chain, samples, fit.x, prior=prior, additions=along(solution, parts), like=fit)
    return JointFit(situation, tuple(choices), parts, fit)


def along(solution: Solution, parts: Sequence[EffectColumns]) -> EffectColumns | None:
    """Return all coefficients that a fit has in addition to the kinematics: the solution's own and the effects'."""
    own = () if solution.additions is None else (solution.additions,)
    return joined([*own, *parts], len(solution.samples)) if own or parts else None


def _parts(
    solution: Solution, observations: Observations, choices: Sequence[Choice], x: Floats
) -> tuple[EffectContext, tuple[EffectColumns, ...]]:
    """Return the effects' displacements of the samples, with the loads and lever arms of parameters (p,) or more."""
    situation = EffectContext(solution.chain, x[: len(solution.chain)], observations)
    return situation, tuple(c.columns(situation).over(solution.samples.average) for c in choices)


def projected(solution: Solution, joint: JointFit, *, without_last: bool = False) -> Projection:
    """Return the projection about a joint fit; its last effect is not projected out, if so asked."""
    kept = joint.parts[:-1] if without_last else joint.parts
    tried = joint.parts[-1] if without_last else None
    return Projection(
        replace(solution, fit=joint.fit, additions=along(solution, kept)), joint.situation, joint.fit, tried
    )


@dataclass(frozen=True)
class Problem:
    """The data of a search, and how they are fitted.

    Attributes:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        prior: of the solution.
        seed: of everything random.
    """

    solution: Solution
    observations: Observations
    prior: Prior
    seed: int

    def rng(self) -> np.random.Generator:
        """Return the generator of detection's signs, the same every time."""
        return np.random.default_rng([self.seed, 2])

    def fit(self, choices: Sequence[Choice], start: Floats) -> JointFit:
        """Fit kinematics and effects, from a start as `joint_fit` takes it."""
        return joint_fit(self.solution, self.observations, choices, self.prior, start)

    def fit_part(self, joint: JointFit, kept: Sequence[Choice]) -> JointFit:
        """Fit kinematics with some of the effects that a fit has, and which it gives the start."""
        return self.fit(kept, joint.start(kept))

    def kinematics_only(self) -> JointFit:
        """Return the fit without effects."""
        chain, fit = self.solution.chain, self.solution.fit
        return JointFit(EffectContext(chain, fit.x[: len(chain)], self.observations), (), (), fit)

    def with_mild_outliers(self, joint: JointFit) -> JointFit:
        """Return the fit with full weight for mild outliers: a missing effect may show in a few samples only."""
        weight, size = joint.fit.weight, np.linalg.norm(joint.error_mm(self.solution), axis=1)
        far_off = (weight < OUTLIER) & (size > _GROSS * np.median(size))
        return replace(joint, fit=replace(joint.fit, weight=np.where(far_off, weight, 1.0)))

    def project(self, joint: JointFit, *, without_last: bool = False) -> Projection:
        """Return `projected` about a fit."""
        return projected(self.solution, joint, without_last=without_last)

    def project_with_mild_outliers(self, joint: JointFit) -> Projection:
        """Return the projection about a fit in which mild outliers count."""
        return self.project(self.with_mild_outliers(joint))
