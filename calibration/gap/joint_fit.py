"""Joint fits of kinematics and effects, and the data of a search that uses many such fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.columns import EffectColumns, joined, nearly_same
from calibration.effects.context import EffectContext
from calibration.effects.fitted import Choice, FittedEffect
from calibration.gap.projected.projection import Projection
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations

OUTLIER = 0.5  # a sample with a smaller weight, its probability of being an inlier, counts as an outlier
_GROSS = 8.0  # multiple of the median error beyond which an outlier is gross


@dataclass(frozen=True)
class JointFit:
    """Kinematics and effects refitted together.

    Attributes:
        context: context of the observations, at the parameters from which loads and lever arms of effects are computed.
        choices: the effects.
        parts: columns of each effect for the samples.
        fit: fit of the parameters (p,), followed by the solution's additional coefficients, then those of the effects.
    """

    context: EffectContext
    choices: tuple[Choice, ...]
    parts: tuple[EffectColumns, ...]
    fit: Fit

    @property
    def _first(self) -> int:
        """Index of the effects' first coefficient in the fit's parameters."""
        return len(self.fit.x) - sum(map(len, self.parts))

    @property
    def additions(self) -> EffectColumns | None:
        """Columns of all effects; None without effects."""
        return joined(self.parts, len(self.parts[0].column)) if self.parts else None

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """The effects with fitted coefficients."""
        return tuple(c.fitted(self.context, *self.coefficients(i)) for i, c in enumerate(self.choices))

    def slice_of(self, number: int) -> slice:
        """Return the slice of one effect's coefficients in the fit's parameters."""
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
        return JointFit(self.context, tuple(self.choices[n] for n in order), tuple(self.parts[n] for n in order), fit)

    def start(self, choices: Sequence[Choice]) -> Floats:
        """Return the start (p + k,) of a fit with the given effects, all of which must be in this fit."""
        coefficients = [self.coefficients(self.choices.index(choice))[0] for choice in choices]
        return np.concatenate([self.fit.x[: self._first], *coefficients])

    def error_mm(self, solution: Solution) -> Floats:
        """Return measured minus fitted positions (m, 3) of the samples of a solution, mm."""
        chain, data, additions = solution.chain, solution.samples.data, along(solution, self.parts)
        x, coefficients = self.fit.x[: len(chain)], self.fit.x[len(chain) :]
        left = solution.samples.position_mm
        if additions is not None:
            data, shift_mm = additions.apply(data, coefficients)
            left = left - shift_mm
        error: Floats = left - chain.positions_mm(x, data)
        return error

    def beyond_limits(self, number: int) -> tuple[str, ...]:
        """Return the names of one effect's coefficients that exceed their hard limits significantly."""
        return self.choices[number].beyond_limits(self.context, *self.coefficients(number))


def joint_fit(
    solution: Solution, observations: Observations, choices: Sequence[Choice], prior: Prior, start: Floats | None = None
) -> JointFit:
    """Refit the kinematics with effects.

    Loads and lever arms depend on the kinematics. If they change an effect by more than a relative 1e-5, a second fit
    uses the loads and lever arms of the first one's result.

    Args:
        solution: the kinematics, with chain and samples.
        observations: the n rows from which the samples were made.
        choices: the effects.
        prior: prior of the solution.
        start: (p,) or more: initial parameters, and coefficients of the first effects; the solution's by default.
    """
    chain, samples = solution.chain, solution.samples
    x = solution.fit.x if start is None else start
    context, parts = _parts(solution, observations, choices, x)
    fit = refine(chain, samples, x, prior=prior, additions=along(solution, parts))
    again = _parts(solution, observations, choices, fit.x)
    if not all(nearly_same(a, b) for a, b in zip(parts, again[1], strict=True)):
        context, parts = again
        fit = refine(chain, samples, fit.x, prior=prior, additions=along(solution, parts), like=fit)
    return JointFit(context, tuple(choices), parts, fit)


def along(solution: Solution, parts: Sequence[EffectColumns]) -> EffectColumns | None:
    """Return the columns of all coefficients in addition to the kinematics, or None if there are none.

    Args:
        solution: the solution, whose own additions come first.
        parts: columns of the effects.
    """
    own = () if solution.additions is None else (solution.additions,)
    return joined([*own, *parts], len(solution.samples)) if own or parts else None


def _parts(
    solution: Solution, observations: Observations, choices: Sequence[Choice], x: Floats
) -> tuple[EffectContext, tuple[EffectColumns, ...]]:
    """Return the columns of effects for the samples, with loads and lever arms at parameters (p,) or more."""
    context = EffectContext(solution.chain, x[: len(solution.chain)], observations)
    return context, tuple(c.columns(context).over(solution.samples.average) for c in choices)


def projected(solution: Solution, joint: JointFit, *, without_last: bool = False) -> Projection:
    """Return the projection at a joint fit.

    Args:
        solution: the kinematics.
        joint: the joint fit.
        without_last: True to leave out the last effect from the directions that are projected out.
    """
    kept = joint.parts[:-1] if without_last else joint.parts
    tried = joint.parts[-1] if without_last else None
    return Projection(
        replace(solution, fit=joint.fit, additions=along(solution, kept)), joint.context, joint.fit, tried
    )


@dataclass(frozen=True)
class Problem:
    """The data of a search, and the settings of its fits.

    Attributes:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        prior: prior of the solution.
        seed: seed of all random numbers.
    """

    solution: Solution
    observations: Observations
    prior: Prior
    seed: int

    def rng(self) -> np.random.Generator:
        """Return a new random generator for detection, always with the same state."""
        return np.random.default_rng([self.seed, 2])

    def fit(self, choices: Sequence[Choice], start: Floats) -> JointFit:
        """Fit kinematics and effects; `start` as for `joint_fit`."""
        return joint_fit(self.solution, self.observations, choices, self.prior, start)

    def fit_part(self, joint: JointFit, kept: Sequence[Choice]) -> JointFit:
        """Fit kinematics with some effects of an existing fit, starting from that fit.

        Args:
            joint: the existing fit.
            kept: the effects to keep.
        """
        return self.fit(kept, joint.start(kept))

    def kinematics_only(self) -> JointFit:
        """Return the fit without effects."""
        chain, fit = self.solution.chain, self.solution.fit
        return JointFit(EffectContext(chain, fit.x[: len(chain)], self.observations), (), (), fit)

    def with_mild_outliers(self, joint: JointFit) -> JointFit:
        """Return the fit with full weight for mild outliers, as a missing effect may affect only a few samples."""
        weight, size = joint.fit.weight, np.linalg.norm(joint.error_mm(self.solution), axis=1)
        far_off = (weight < OUTLIER) & (size > _GROSS * np.median(size))
        return replace(joint, fit=replace(joint.fit, weight=np.where(far_off, weight, 1.0)))

    def project(self, joint: JointFit, *, without_last: bool = False) -> Projection:
        """Return the projection at a fit; see `projected`."""
        return projected(self.solution, joint, without_last=without_last)

    def project_with_mild_outliers(self, joint: JointFit) -> Projection:
        """Return the projection at a fit with full weight for mild outliers."""
        return self.project(self.with_mild_outliers(joint))
