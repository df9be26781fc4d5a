"""What every step of the search goes by: the data, how they are fitted, and what is looked at about a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import Choice
from calibration.gap.adopt import JointFit, joint_fit, projected
from calibration.gap.grammar import Found as Formula
from calibration.gap.projection import Projection
from calibration.identification.additions import NO_JOINT, Additions
from calibration.identification.refinement import Prior, refine
from calibration.identification.solve import Solution
from calibration.observations import Floats, Observations

OUTLIER = 0.5  # probability of being none
_GROSS = 8.0  # times the median error


@dataclass(frozen=True)
class Problem:
    """The data of a search.

    Attributes:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        prior: as the solution was found with.
        seed: of everything random.
        formulas: of what no library has, that the solution's fit has beside the kinematics.
    """

    solution: Solution
    observations: Observations
    prior: Prior
    seed: int
    formulas: tuple[Formula, ...] = ()

    def beside(self, formulas: Sequence[Formula]) -> Problem:
        """The same data with formulas fitted along, each of a size like the one that it has."""
        chain, samples, fit = self.solution.chain, self.solution.samples, self.solution.fit
        additions = Additions(
            tuple(str(f.term) for f in formulas),
            np.full(len(formulas), NO_JOINT),
            np.zeros((len(samples), len(formulas))),
            np.array([abs(f.coefficient) for f in formulas]),
            np.stack([f.term.moved_mm for f in formulas], axis=2),
        )
        fit = refine(chain, samples, fit.x[: len(chain)], prior=self.prior, additions=additions)
        solution = replace(self.solution, fit=fit, additions=additions)
        return replace(self, solution=solution, formulas=tuple(formulas))

    def rng(self) -> np.random.Generator:
        """Draws the signs of detection, the same every time."""
        return np.random.default_rng([self.seed, 2])

    def fit(self, choices: Sequence[Choice], start: Floats) -> JointFit:
        """Kinematics with effects, from a start as `joint_fit` takes it."""
        return joint_fit(self.solution, self.observations, choices, self.prior, start)

    def alone(self) -> JointFit:
        """The kinematics alone."""
        chain, fit = self.solution.chain, self.solution.fit
        return JointFit(Situation(chain, fit.x[: len(chain)], self.observations), (), (), fit)

    def counted(self, joint: JointFit) -> JointFit:
        """A fit in which outliers count that are not far off: what it lacks may show in a few samples only."""
        weight, size = joint.fit.weight, np.linalg.norm(joint.error_mm(self.solution), axis=1)
        far_off = (weight < OUTLIER) & (size > _GROSS * np.median(size))
        return replace(joint, fit=replace(joint.fit, weight=np.where(far_off, weight, 1.0)))

    def open(self, joint: JointFit) -> Projection:
        """About a fit, for what it lacks."""
        return self.project(self.counted(joint))

    def project(self, joint: JointFit, *, without_last: bool = False) -> Projection:
        """About a fit; its last effect is no part of what is taken out, if so asked."""
        return projected(self.solution, joint, without_last=without_last)
