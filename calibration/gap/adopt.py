"""Effects taken into a model: the joint refit with the kinematics, and those that the caller asks for by name."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from calibration.effects.base import Situation
from calibration.effects.fitted import Choice, FittedEffect
from calibration.effects.library import library, parse_effects
from calibration.errors import DataError
from calibration.gap.projection import Projection
from calibration.gap.screen import LEAST_KNOWN, LOG_SCALE_ODDS, SCALES, Screen, place_of, variants_at
from calibration.identification.additions import Additions, joined, same_columns
from calibration.identification.identifiability import identifiability
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.solve import Solution
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations

_CHOICES = 4  # of variants: the noise that they are weighed with depends on which are in


@dataclass(frozen=True)
class Adopted:
    """Kinematics and effects together.

    Attributes:
        solution: with the joint fit and its additions; as it was given where no effect was taken in.
        geometric: the fit of the kinematics alone.
        effects: what was taken in.
        reason: why these, or why none, a clause.
        warnings: sentences for people.
        structured: whether what is left is known to depend on something.
    """

    solution: Solution
    geometric: Fit
    effects: tuple[FittedEffect, ...] = ()
    reason: str = "switched off"
    warnings: tuple[str, ...] = ()
    structured: bool = False


@dataclass(frozen=True)
class JointFit:
    """Kinematics and effects refitted together.

    Attributes:
        situation: of the observations, at the parameters whose loads and lever arms the effects have.
        choices: the effects.
        parts: what each of them does to the samples.
        fit: of parameters (p,), of what the solution has beside them, and last of their coefficients, in this order.
    """

    situation: Situation
    choices: tuple[Choice, ...]
    parts: tuple[Additions, ...]
    fit: Fit

    @property
    def _first(self) -> int:
        """Which of the fit's parameters is the first coefficient of the effects."""
        return len(self.fit.x) - sum(map(len, self.parts))

    @property
    def additions(self) -> Additions | None:
        """All coefficients; None where there are no effects."""
        return joined(self.parts, len(self.parts[0].column)) if self.parts else None

    def own(self, number: int) -> slice:
        """Which of the fit's parameters are the coefficients of one of the effects."""
        first = self._first + sum(len(part) for part in self.parts[:number])
        return slice(first, first + len(self.parts[number]))

    def found(self, number: int) -> tuple[Floats, Floats]:
        """Values and standard errors of the coefficients of one of the effects."""
        own = self.own(number)
        return self.fit.x[own], np.sqrt(np.diag(self.fit.covariance)[own])

    def with_last(self, number: int) -> JointFit:
        """The same fit with one of its effects as the last."""
        order = [*(n for n in range(len(self.choices)) if n != number), number]
        own = np.concatenate([np.arange(self._first), *(np.r_[self.own(n)] for n in order)])
        fit = replace(self.fit, x=self.fit.x[own], covariance=self.fit.covariance[np.ix_(own, own)])
        return JointFit(self.situation, tuple(self.choices[n] for n in order), tuple(self.parts[n] for n in order), fit)

    def start(self, choices: Sequence[Choice]) -> Floats:
        """(p + k,) where a fit of these effects, all of them in this one, begins."""
        coefficients = [self.found(self.choices.index(choice))[0] for choice in choices]
        return np.concatenate([self.fit.x[: self._first], *coefficients])

    def error_mm(self, solution: Solution) -> Floats:
        """(m, 3) what the fit leaves of the samples of a solution of its chain, mm."""
        chain, data, additions = solution.chain, solution.samples.data, along(solution, self.parts)
        x, coefficients = self.fit.x[: len(chain)], self.fit.x[len(chain) :]
        left = solution.samples.position_mm
        if additions is not None:
            data = replace(data, readings=data.readings + additions.change(coefficients, data.readings.shape[1]))
            left = left - additions.shifted_mm(coefficients)
        error: Floats = left - chain.positions_mm(x, data)
        return error

    def beyond(self, number: int) -> tuple[str, ...]:
        """Names of its coefficients that are beyond their hard limits by more than chance."""
        return self.choices[number].beyond(self.situation, *self.found(number))

    @property
    def effects(self) -> tuple[FittedEffect, ...]:
        """As a model has them."""
        return tuple(c.fitted(self.situation, *self.found(i)) for i, c in enumerate(self.choices))


def joint_fit(
    solution: Solution, observations: Observations, choices: Sequence[Choice], prior: Prior, start: Floats | None = None
) -> JointFit:
    """Refit the kinematics with effects.

    Loads and lever arms depend on the kinematics: where effects do, a second fit has those of the first one's.

    Args:
        solution: of the kinematics, for its chain and samples.
        observations: n rows that the samples are of.
        choices: the effects.
        prior: as the solution was found with.
        start: (p,) or more: parameters, and coefficients of the first of the effects; the solution's by default.
    """
    chain, samples = solution.chain, solution.samples
    x = solution.fit.x if start is None else start
    situation, parts = _parts(solution, observations, choices, x)
    fit = refine(chain, samples, x, prior=prior, additions=along(solution, parts))
    again = _parts(solution, observations, choices, fit.x)
    if not all(same_columns(a, b) for a, b in zip(parts, again[1], strict=True)):
        situation, parts = again
        fit = refine(chain, samples, fit.x, prior=prior, additions=along(solution, parts))
    return JointFit(situation, tuple(choices), parts, fit)


def along(solution: Solution, parts: Sequence[Additions]) -> Additions | None:
    """All coefficients that a fit has beside the kinematics: the solution's own, and those of effects."""
    own = () if solution.additions is None else (solution.additions,)
    return joined([*own, *parts], len(solution.samples)) if own or parts else None


def _parts(
    solution: Solution, observations: Observations, choices: Sequence[Choice], x: Floats
) -> tuple[Situation, tuple[Additions, ...]]:
    """What effects do to the samples, with the loads and lever arms of parameters (p,) or more."""
    situation = Situation(solution.chain, x[: len(solution.chain)], observations)
    return situation, tuple(c.additions(situation).over(solution.samples.average) for c in choices)


def adopt(solution: Solution, observations: Observations, effects: str, *, prior: Prior = "recalibration") -> Adopted:
    """Take effects into a solution that are asked for by name.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        effects: `none`, or FAMILY@WHERE,...
        prior: as the solution was found with.

    Raises:
        ValueError: as `parse_effects`.
        DataError: an effect lacks a column, or cannot be at its place.
    """
    if effects == "none":
        return Adopted(solution, solution.fit)
    situation = Situation(solution.chain, solution.fit.x[: len(solution.chain)], observations)
    names = parse_effects(effects, solution.chain.rig)
    for name, where in names:
        family = library()[name]
        if family.known(situation, where).mean() < LEAST_KNOWN:
            raise DataError("observations", f"{name}@{where} needs {family.needs(where)}, in half of the rows at least")
        if not family.variants(situation, where):
            raise DataError("observations", f"{name}@{where} cannot do anything in any pose; leave it out")
    joint = _in_finest_forms(solution, _best_variants(solution, situation, names, prior), prior)
    warnings = tuple(
        f"{choice}: {name} came out beyond what is physical; it may stand for another effect"
        for number, choice in enumerate(joint.choices)
        for name in joint.beyond(number)
    )
    return adopted(solution, joint, "asked for by name", warnings)


def adopted(solution: Solution, joint: JointFit, reason: str, warnings: tuple[str, ...] = ()) -> Adopted:
    """What a joint fit makes of a solution of the kinematics alone."""
    together = replace(solution, fit=joint.fit, additions=joint.additions)
    return Adopted(together, solution.fit, joint.effects, reason, warnings)


def with_effects(model: CalibratedModel, taken: Adopted) -> CalibratedModel:
    """A model of the kinematics alone with the effects taken in.

    Their coefficients count among the parameters that the data must determine, but for those that outputs do not list.
    """
    solution, fit, parameters = taken.solution, taken.solution.fit, len(model.chain)
    seen = model.identifiability
    if taken.effects:
        listed = [c.name in {r.name for r in e.reported} for e in taken.effects for c in e.coefficients]
        seen = identifiability(
            solution.chain,
            solution.samples,
            fit.x,
            fit.excess_variance,
            additions=solution.additions,
            listed=np.array(listed),
        )
    return replace(
        model,
        values=fit.x[:parameters],
        covariance=fit.covariance,
        geometric_values=taken.geometric.x,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=math.sqrt(fit.excess_variance),
        effects_noise_mm=math.sqrt(model.known_noise_mm2 + 3.0 * fit.excess_variance),
        effects=taken.effects,
        effects_reason=taken.reason,
        identifiability=seen,
    )


def refined_choice(situation: Situation, choice: Choice, over: Projection) -> Choice:
    """The finest form of an effect, among those about the one that was chosen.

    Args:
        situation: of the observations.
        choice: the effect.
        over: a projection in which it is no part of what is taken out.
    """
    finer = finer_forms(situation, choice)
    if not finer:
        return choice
    probability = softmax(evidence_of_forms(situation, finer, over))
    return replace(choice, settings=library()[choice.family].settled([c.settings for c in finer], probability))


def finer_forms(situation: Situation, choice: Choice) -> tuple[Choice, ...]:
    """Finer forms about one of an effect, that one among them; none where there is nothing finer."""
    finer = library()[choice.family].refined(situation, choice.where, choice.settings)
    return tuple(replace(choice, settings=settings) for settings in finer) if len(finer) > 1 else ()


def evidence_of_forms(situation: Situation, forms: Sequence[Choice], over: Projection) -> Floats:
    """(m,) log evidence of each of the forms of one effect by itself."""
    screen = Screen(over, [place_of(situation, over, forms[0].family, forms[0].where, forms)])
    return np.array([screen.log_bayes_factor([(0, option)]) for option in range(len(forms))])


def projected(solution: Solution, joint: JointFit, *, without_last: bool = False) -> Projection:
    """The projection about a joint fit; its last effect is no part of what is taken out, if so asked."""
    kept = joint.parts[:-1] if without_last else joint.parts
    tried = joint.parts[-1] if without_last else None
    return Projection(
        replace(solution, fit=joint.fit, additions=along(solution, kept)), joint.situation, joint.fit, tried
    )


def _in_finest_forms(solution: Solution, joint: JointFit, prior: Prior) -> JointFit:
    """The fit with each effect in its finest form beside the others."""
    for choice in joint.choices:
        if not finer_forms(joint.situation, choice):
            continue
        observations = joint.situation.observations
        others = [c for c in joint.choices if c != choice]
        tried = joint_fit(solution, observations, [*others, choice], prior, joint.start([*others, choice]))
        finer = refined_choice(tried.situation, choice, projected(solution, tried, without_last=True))
        joint = joint_fit(
            solution, observations, [finer if c == choice else c for c in joint.choices], prior, joint.fit.x
        )
    return joint


def _best_variants(
    solution: Solution, situation: Situation, names: Sequence[tuple[str, str]], prior: Prior
) -> JointFit:
    """The effects in the variants of the greatest evidence together: changed one at a time, until none is better."""
    observations = situation.observations
    variants = [variants_at(situation, name, where) for name, where in names]
    chosen = [(0, 1.0)] * len(names)
    joint = joint_fit(solution, observations, _scaled(variants, chosen), prior)
    for _ in range(_CHOICES):
        over = Projection(solution, joint.situation, joint.fit, joint.additions)
        places = [
            place_of(joint.situation, over, name, where, own)
            for (name, where), own in zip(names, variants, strict=True)
        ]
        screen, before = Screen(over, places), list(chosen)
        for _ in range(_CHOICES):
            start = list(chosen)
            for number, place in enumerate(places):
                values = {}
                for one in itertools.product(range(len(place.options)), SCALES):
                    together = [*chosen[:number], one, *chosen[number + 1 :]]
                    which = [(at, option) for at, (option, _) in enumerate(together)]
                    values[one] = screen.log_bayes_factor(which, [scale for _, scale in together])
                    values[one] += float(place.log_odds[one[0]]) + LOG_SCALE_ODDS[one[1]]
                chosen[number] = max(values, key=values.__getitem__)
            if chosen == start:
                break
        if chosen == before:
            break
        joint = joint_fit(solution, observations, _scaled(variants, chosen), prior)
    return joint


def _scaled(variants: Sequence[Sequence[Choice]], chosen: Sequence[tuple[int, float]]) -> list[Choice]:
    return [replace(own[option], scale=scale) for own, (option, scale) in zip(variants, chosen, strict=True)]
