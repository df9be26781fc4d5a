"""Effects taken into a model: chosen by the data or by name, refitted jointly with the kinematics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.effects.base import Situation
from calibration.effects.fitted import Choice, FittedEffect, joined
from calibration.effects.library import library, parse_effects
from calibration.effects.selection import NO_GAIN, Labels, LinearFit, choose, doubt
from calibration.errors import DataError
from calibration.identification.additions import Additions
from calibration.identification.identifiability import identifiability
from calibration.identification.refinement import Fit, Prior, refine
from calibration.identification.samples import Samples
from calibration.identification.solve import Solution
from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations

AUTOMATIC = ("joint_compliance",)  # families that `auto` may take
_LEAST_KNOWN = 0.5  # share of the rows that have what an effect needs
_SELECTION_ROWS = 1500  # enough to choose; the fit itself takes all
_CELL_MM = 100.0
_OUTLIER = 0.5  # probability of being none
_GROSS = 8.0  # times the median error


@dataclass(frozen=True)
class Adopted:
    """Kinematics and effects together.

    Attributes:
        solution: with the joint fit and its additions; as it was given where no effect was taken in.
        geometric: the fit of the kinematics alone.
        effects: what was taken in.
        reason: why these, or why none, a clause.
        warnings: sentences for people.
    """

    solution: Solution
    geometric: Fit
    effects: tuple[FittedEffect, ...] = ()
    reason: str = "switched off"
    warnings: tuple[str, ...] = ()


def adopt(
    solution: Solution,
    observations: Observations,
    effects: str = "auto",
    *,
    prior: Prior = "recalibration",
    seed: int = 0,
) -> Adopted:
    """Take effects into a solution.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        effects: `none`; `auto` for the compliances of joints that the data ask for; or FAMILY@WHERE,... for exactly
            these.
        prior: as the solution was found with.
        seed: of the folds.

    Raises:
        ValueError: as `parse_effects`.
        DataError: an effect that was asked for by name lacks a column, or cannot be at its place.
    """
    if effects == "none":
        return Adopted(solution, solution.fit)
    situation = Situation(solution.chain, solution.fit.x, observations)
    if effects == "auto":
        return _automatic(solution, situation, prior, seed)
    return _named(solution, situation, parse_effects(effects, solution.chain.rig), prior, seed)


def with_effects(model: CalibratedModel, adopted: Adopted) -> CalibratedModel:
    """A model of the kinematics alone with the effects taken in.

    Their coefficients count among the parameters that the data must determine.
    """
    solution, fit, parameters = adopted.solution, adopted.solution.fit, len(model.chain)
    seen = model.identifiability
    if adopted.effects:
        seen = identifiability(
            solution.chain, solution.samples, fit.x, fit.excess_variance, additions=solution.additions
        )
    other = model.effects_noise_mm**2 - 3.0 * model.excess_sigma_mm**2
    return replace(
        model,
        values=fit.x[:parameters],
        covariance=fit.covariance,
        geometric_values=adopted.geometric.x,
        prior_scale=fit.prior_scale,
        excess_sigma_mm=math.sqrt(fit.excess_variance),
        effects_noise_mm=math.sqrt(max(other, 0.0) + 3.0 * fit.excess_variance),
        effects=adopted.effects,
        effects_reason=adopted.reason,
        identifiability=seen,
    )


def _automatic(solution: Solution, situation: Situation, prior: Prior, seed: int) -> Adopted:
    places = [(name, where) for name in AUTOMATIC for where in library()[name].places(situation.rig)]
    possible = [v for name, where in places if (v := _variants(situation, name, where))]
    if not possible:
        return Adopted(
            solution, solution.fit, reason="neither masses in the rig file nor measured torques tell the loads"
        )
    search, chosen = _chosen(solution, situation, possible, prior, seed, required=False)
    reason_against = search.doubt(chosen) if chosen else NO_GAIN
    while reason_against is None:
        joint, fit = _joint_fit(solution, situation, chosen, prior, search.start(chosen))
        kept = tuple(c for c, found in _by_choice(solution, chosen, joint, fit) if not c.beyond(situation, *found))
        # Not the fits' costs: a gross outlier costs the more, the smaller the noise beside it.
        if kept == chosen and fit.excess_variance < solution.fit.excess_variance:
            reason = f"the data ask for {', '.join(str(c) for c in chosen)}"
            return _adopted(solution, situation, chosen, joint, fit, reason)
        chosen = kept if kept != chosen else ()
        reason_against = search.doubt(chosen) if chosen else NO_GAIN
    return Adopted(solution, solution.fit, reason=reason_against)


def _named(
    solution: Solution, situation: Situation, names: Sequence[tuple[str, str]], prior: Prior, seed: int
) -> Adopted:
    for name, where in names:
        family = library()[name]
        if family.known(situation, where).mean() < _LEAST_KNOWN:
            raise DataError("observations", f"{name}@{where} needs {family.needs(where)}, in half of the rows at least")
        if not family.variants(situation, where):
            raise DataError("observations", f"{name}@{where} cannot do anything in any pose; leave it out")
    possible = [_variants(situation, name, where) for name, where in names]
    search, chosen = _chosen(solution, situation, possible, prior, seed, required=True)
    joint, fit = _joint_fit(solution, situation, chosen, prior, search.start(chosen))
    warnings = tuple(
        f"{c}: {name} came out beyond what is physical; it may stand for another effect"
        for c, found in _by_choice(solution, chosen, joint, fit)
        for name in c.beyond(situation, *found)
    )
    return _adopted(solution, situation, chosen, joint, fit, "asked for by name", warnings)


def _chosen(
    solution: Solution,
    situation: Situation,
    possible: Sequence[tuple[Choice, ...]],
    prior: Prior,
    seed: int,
    *,
    required: bool,
) -> tuple[_Search, tuple[Choice, ...]]:
    """The choice of the greatest evidence.

    To kinematics alone a fix that shows an effect may look like an outlier, far off as such fixes are often the rare
    ones. So the choice is made with all fixes, and without those that are far off; of the two the one whose effects
    leave fewer outliers over says which fixes count as such, and the choice is made again.
    """
    additions = [[_of_samples(c.additions(situation), solution.samples) for c in variants] for variants in possible]
    fits: list[Fit] = []
    for weight in _first_weights(solution):
        search = _Search(solution, possible, additions, weight, seed)
        chosen = search.best(required=required)
        fit = solution.fit
        if chosen:
            _, fit = _joint_fit(solution, situation, chosen, prior, search.start(chosen))
        fits.append(fit)
    best = min(fits, key=lambda fit: (int((fit.weight < _OUTLIER).sum()), fit.excess_variance))
    search = _Search(solution, possible, additions, best.weight, seed)
    return search, search.best(required=required)


def _first_weights(solution: Solution) -> Iterator[Floats]:
    """(m,) weights of the samples before any effect is known."""
    yield np.ones(len(solution.samples))
    error = solution.samples.position_mm - solution.chain.positions_mm(solution.fit.x, solution.samples.data)
    size = np.linalg.norm(error, axis=1)
    gross = (solution.fit.weight < _OUTLIER) & (size > _GROSS * np.median(size))
    if gross.any():
        yield np.where(gross, solution.fit.weight, 1.0)


def _variants(situation: Situation, family: str, where: str) -> tuple[Choice, ...]:
    """What may be at a place; nothing where half of the rows lack what it needs."""
    if library()[family].known(situation, where).mean() < _LEAST_KNOWN:
        return ()
    return tuple(Choice(family, where, settings) for settings in library()[family].variants(situation, where))


class _Search:
    """The choice among the variants at every place, on a share of the rows where there are very many."""

    def __init__(
        self,
        solution: Solution,
        possible: Sequence[tuple[Choice, ...]],
        additions: Sequence[Sequence[Additions]],
        weight: Floats,
        seed: int,
    ) -> None:
        samples = solution.samples
        rows = np.arange(len(samples))
        if len(rows) > _SELECTION_ROWS:
            rows = np.sort(np.random.default_rng(seed).permutation(rows)[:_SELECTION_ROWS])
        self._possible, self._seed = possible, seed
        self._labels = _labels(samples)[rows]
        self._linear = LinearFit(solution.chain, samples, solution.fit, weight, rows)
        self._additions = [[own.select(rows) for own in variants] for variants in additions]
        self._alternatives = [self._linear.alternatives(variants) for variants in self._additions]
        self._odds = [[library()[c.family].odds(c.settings) for c in variants] for variants in possible]

    def best(self, *, required: bool) -> tuple[Choice, ...]:
        """The choice of the greatest evidence."""
        options = choose(self._linear, self._alternatives, self._odds, required=required)
        return tuple(v[o] for v, o in zip(self._possible, options, strict=True) if o is not None)

    def start(self, chosen: Sequence[Choice]) -> Floats:
        """(p + k,) parameters and coefficients of the linearised fit."""
        options = self._options(chosen)
        taken = [self._additions[place][o] for place, o in enumerate(options) if o is not None]
        return self._linear.solve(joined(taken, len(self._labels)))

    def doubt(self, chosen: Sequence[Choice]) -> str | None:
        """Why a choice may be chance; None if it is not."""
        return doubt(self._linear, self._alternatives, self._odds, self._options(chosen), self._labels, self._seed)

    def _options(self, chosen: Sequence[Choice]) -> list[int | None]:
        return [next((o for o, c in enumerate(variants) if c in chosen), None) for variants in self._possible]


def _labels(samples: Samples) -> Labels:
    """(m,) workspace cells for grouped splits, a standstill in that of its first sample.

    Set-ups and sessions are no groups here: without a set-up's fixes its base, a part of the fit, has no place.
    """
    cell = np.rint(samples.position_mm / _CELL_MM).astype(int)
    first = np.arange(len(samples)) if samples.standstill is None else samples.standstill
    return np.array([f"{s}|{x},{y},{z}" for s, (x, y, z) in zip(samples.data.setup[first], cell[first], strict=True)])


def _of_samples(additions: Additions, samples: Samples) -> Additions:
    return replace(additions, column=samples.average(additions.column))


def _joint_fit(
    solution: Solution, situation: Situation, chosen: Sequence[Choice], prior: Prior, start: Floats
) -> tuple[Additions, Fit]:
    """Kinematics and the chosen effects from `start` (p + k,); the additions are of the samples.

    Loads depend on the kinematics: the second fit has those of the first one's.
    """
    chain, samples, x = solution.chain, solution.samples, start
    for _ in range(2):
        at = replace(situation, x=x[: len(chain)])
        joint = joined([_of_samples(c.additions(at), samples) for c in chosen], len(samples))
        fit = refine(chain, samples, x, prior=prior, additions=joint)
        x = fit.x
    return joint, fit


def _by_choice(
    solution: Solution, chosen: Sequence[Choice], joint: Additions, fit: Fit
) -> list[tuple[Choice, tuple[Floats, Floats]]]:
    """Every choice with the values of its coefficients and their standard errors."""
    values, errors = fit.x[len(solution.chain) :], np.sqrt(np.diag(fit.covariance))[len(solution.chain) :]
    own = [[name.startswith(f"{c}:") for name in joint.names] for c in chosen]
    return [(c, (values[mask], errors[mask])) for c, mask in zip(chosen, own, strict=True)]


def _adopted(
    solution: Solution,
    situation: Situation,
    chosen: Sequence[Choice],
    joint: Additions,
    fit: Fit,
    reason: str,
    warnings: tuple[str, ...] = (),
) -> Adopted:
    effects = tuple(c.fitted(situation, *found) for c, found in _by_choice(solution, chosen, joint, fit))
    return Adopted(replace(solution, fit=fit, additions=joint), solution.fit, effects, reason, warnings)
