"""The search for missing effects: in all rows, in a part of the rows, and in the presence of unexplained structure."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.gap.adoption import Adopted, adopted
from calibration.gap.background.blocks import displacement_blocks, possible_blocks, smooth_blocks, time_blocks
from calibration.gap.background.breaks import find_break
from calibration.gap.background.causes import names_given_cause
from calibration.gap.background.naming import Names, evidence_alone, names_given_background
from calibration.gap.background.outside import (
    MOST_FORMULAS,
    cost_with_formulas,
    formula_block,
    formulas_log_bayes_factor,
    formulas_suffice,
    is_in_library,
    residual_formula,
)
from calibration.gap.background.search import background_log_bayes_factor
from calibration.gap.candidates import partly_lacking
from calibration.gap.detection import detect
from calibration.gap.formulas.grammar import Formula, Grammar
from calibration.gap.joint_fit import OUTLIER, Problem, joint_fit
from calibration.gap.projected.projection import follows_path
from calibration.gap.regimes import effect_in_regime
from calibration.gap.screening import by_family
from calibration.gap.search_result import STRUCTURE, SearchResult
from calibration.gap.stepwise.search import MANY_OUTLIERS, StepwiseSearch
from calibration.gap.unknown_inputs import (
    Unknowns,
    filled_in,
    implausible_runs,
    unknown_inputs,
    unknowns_of_any_size,
    widened,
    with_doubt,
    with_unknowns,
    with_warning,
    without_unknowns,
)
from calibration.identification.reading_steps import in_true_steps
from calibration.identification.refinement import Prior
from calibration.identification.solve import Solution
from calibration.observations import Observations

_REGIME = 15.0  # log Bayes factor required of an effect in a part of the data, as variable and border are selected
_MOST_REPEATS = 5  # of the search, as effects that lack inputs in some rows may be found with unknowns for others
_LEAST_COMPLETE = 0.5  # share of rows that have all inputs
_MOST_INPUTS = 4  # that are lacking in different rows, for a search with unknowns of each alone
_CONTRADICTION = 30.0  # nats that an unknown larger than its effect counts against it
_LEAST_SAMPLES = 60  # with fewer samples, the evidence of a background may come from a few fixes

_Given = tuple[SearchResult, Unknowns | None]


def search(
    solution: Solution,
    observations: Observations,
    families: Collection[str],
    *,
    prior: Prior = "recalibration",
    seed: int = 0,
) -> SearchResult:
    """Find the effects that the data require.

    Args:
        solution: the kinematics alone, fitted to `observations`.
        observations: the rows.
        families: families of effects that may be named.
        prior: prior of the solution.
        seed: random seed of half-samples and folds.
    """
    observations = filled_in(observations, solution.samples)
    seen = in_true_steps(solution, observations, prior)
    found, unknowns = _with_unknowns(Problem(seen, observations, prior, seed), families)
    if seen is not solution or unknowns is not None:
        # The model uses the reading noise of its rig file, and counts additional noise as scatter.
        given = solution if unknowns is None else with_unknowns(solution, unknowns, prior)
        before, start = found.adopted, found.joint.fit.x
        outcome = Adopted(given, given.fit, reason=before.reason)
        if found.joint.choices:
            start = start if unknowns is None else start[: len(solution.chain)]
            joint = joint_fit(given, observations, found.joint.choices, prior, start)
            outcome = adopted(given, joint, before.reason)
        found = replace(found, adopted=replace(outcome, warnings=before.warnings, structured=before.structured))
    if unknowns is None:
        return found
    return replace(found, adopted=without_unknowns(found.adopted, solution.samples, unknowns))


def _with_unknowns(problem: Problem, families: Collection[str]) -> _Given:
    """Return the effects that the data require, and the unknowns of samples that lack their inputs, for the final fit.

    The effects that lack inputs, and their sizes, are first found with unknowns of any size, so that only the samples
    that have the inputs speak. Then all samples are fitted with unknowns of the size found. If no name is certain then,
    as other causes would explain the samples that lack the input as well, the names of the first search stand. In the
    final fit, unknowns have any size again, as those of an effect of one sign are no noise about zero.
    """
    wide = _with_any_size(problem, families)
    if wide is None:
        return _search(problem, families), None
    plain = None if _lack_inputs(wide[0]) else _search(problem, families)
    sized = _with_sizes(problem, families, wide, _lack_inputs(plain or wide[0]))
    if _lack_inputs(sized[0]):
        return _without_implausible(problem, families, *sized)
    if _lacking(wide[0].joint.effects, wide[0]):
        return wide
    plain = plain or _search(problem, families)
    doubted = _lacking(plain.joint.effects, plain)
    if not doubted:
        return plain, None
    return replace(sized[0], adopted=with_doubt(sized[0].adopted, doubted)), widened(
        sized[1], problem.solution.chain.rig
    )


def _given(problem: Problem, families: Collection[str], unknowns: Unknowns) -> tuple[SearchResult, Unknowns]:
    return _search(
        replace(problem, solution=with_unknowns(problem.solution, unknowns, problem.prior)), families
    ), unknowns


def _with_any_size(problem: Problem, families: Collection[str]) -> tuple[SearchResult, Unknowns] | None:
    """Return the effects that samples with all inputs show, or else with one input; None if no inputs are lacking."""
    found = None
    for unknowns in _each_any_size(problem, families):
        found = _given(problem, families, unknowns)
        if _lack_inputs(found[0]):
            break
    return found


def _with_sizes(
    problem: Problem,
    families: Collection[str],
    wide: tuple[SearchResult, Unknowns],
    effects: Sequence[FittedEffect],
) -> tuple[SearchResult, Unknowns]:
    """Return the effects that all samples require, with unknowns of the size of effects that lack inputs.

    Args:
        problem: the data.
        families: families of effects that may be named.
        wide: result with unknowns of any size.
        effects: effects that lack inputs.
    """
    found, unknowns = wide
    for _ in range(_MOST_REPEATS):
        lacking = unknown_inputs(effects, found.joint.context, problem.solution.samples)
        if lacking is None or lacking.is_like(unknowns):
            break
        found, unknowns = _given(problem, families, lacking)
        effects = _lack_inputs(found)
    return found, unknowns


def _without_implausible(
    problem: Problem, families: Collection[str], found: SearchResult, unknowns: Unknowns
) -> _Given:
    """Return a result without the unknowns that are larger than its effects, if their cause gets a name then.

    Otherwise return it with a warning of them.
    """
    effects, samples = _lack_inputs(found), problem.solution.samples
    implausible = implausible_runs(found.joint, unknowns)
    if not len(implausible):
        return found, widened(unknowns, problem.solution.chain.rig)
    fewer = unknown_inputs(effects, found.joint.context, samples, implausible.names)
    if fewer is not None:
        tried, _ = _given(problem, families, fewer)
        if _names_more(tried, found, len(implausible)):
            return tried, fewer
    told = with_warning(found.adopted, effects, implausible, samples)
    return replace(found, adopted=told), widened(unknowns, problem.solution.chain.rig)


def _each_any_size(problem: Problem, families: Collection[str]) -> Iterator[Unknowns]:
    """Yield the unknowns of any size of all samples that lack inputs.

    Then yield those of one input after the other, where so many inputs are lacking that few rows have all.
    """
    context, samples = problem.kinematics_only().context, problem.solution.samples
    effects = list(partly_lacking(context, families))
    if not effects:
        return
    known = np.array([library()[name].known(context, where) for name, where in effects])
    inputs = np.unique(known, axis=0, return_inverse=True)[1].reshape(-1)
    together = [effects]
    if known.all(axis=0).mean() < _LEAST_COMPLETE and inputs.max() < _MOST_INPUTS:
        together += [
            [effect for effect, own in zip(effects, inputs, strict=True) if own == number]
            for number in range(inputs.max() + 1)
        ]
    for some in together:
        if (unknowns := unknowns_of_any_size(some, context, samples)) is not None:
            yield unknowns


def _lack_inputs(found: SearchResult) -> list[FittedEffect]:
    """Return the effects of a result that lack inputs in some rows, or else the most probable alternative that does."""
    possible = (one.fitted(found.joint.context) for one in found.alternatives)
    return _lacking(found.joint.effects, found) or _lacking(possible, found)[:1]


def _lacking(effects: Iterable[FittedEffect], found: SearchResult) -> list[FittedEffect]:
    """Return those of some effects that lack inputs in some rows of a result."""
    context, samples = found.joint.context, found.problem.solution.samples
    return [effect for effect in effects if unknown_inputs([effect], context, samples) is not None]


def _names_more(tried: SearchResult, found: SearchResult, fewer: int) -> bool:
    """Return True if a result with fewer unknowns has all names of another and a further one, and is as probable."""
    names, known = (set(map(str, one.joint.choices)) for one in (tried, found))
    return names > known and tried.joint.fit.cost < found.joint.fit.cost + fewer * _CONTRADICTION


def _search(problem: Problem, families: Collection[str]) -> SearchResult:
    """Return the effects that the data require, and the break of the machine if there is one."""
    whole = StepwiseSearch(problem, families)
    found = _in_regimes(problem, families, whole.run(), whole.least_cost)
    found = _with_background(problem, families, found)
    broken = find_break(problem, found.joint)
    if broken is None:
        return found
    by_formulas = formulas_log_bayes_factor(problem, found.joint, found.strongest_formula)
    return replace(found, machine_break=broken if broken.log_bayes_factor > by_formulas else None)


def _in_regimes(problem: Problem, families: Collection[str], found: SearchResult, least_cost: float) -> SearchResult:
    """Return a result with an effect in a part of the data, if it is more probable and leaves only noise.

    The rows in which it acts may look like outliers without it, so a fit in which all rows have full weight is also
    tried where there are many outliers. If at most one effect in all rows leaves only noise, the search in parts is
    first limited to the family of this effect, and ends if that is no improvement.

    Args:
        problem: the data.
        families: families of effects that may be named.
        found: the result with effects that act in all rows.
        least_cost: smallest cost of all fits of that search, including those with uncertain effects.
    """
    alone, like = problem.with_mild_outliers(problem.kinematics_only()), found.candidates.candidates
    if len(found.joint.choices) <= 1 and _leaves_noise(problem, found):
        one = effect_in_regime(problem, alone, [choice.family for choice in found.joint.choices], like)
        if one is None or found.joint.fit.cost - one.joint.fit.cost < _REGIME:
            return found
    starts = [alone, *([found.joint] if found.joint.choices else [])]
    if (alone.fit.weight < OUTLIER).mean() >= MANY_OUTLIERS:
        starts.append(replace(alone, fit=replace(alone.fit, weight=np.ones_like(alone.fit.weight))))
    with_formulas: float | None = None
    for start in starts:
        is_last = start is found.joint
        one = effect_in_regime(problem, start, families, like, least_cost - _REGIME, is_last=is_last)
        if one is None or least_cost - one.joint.fit.cost < _REGIME:
            continue
        if with_formulas is None:
            with_formulas = cost_with_formulas(problem, found.joint, found.strongest_formula)
        if with_formulas - one.joint.fit.cost < _REGIME:
            continue
        if is_last and detect(Grammar(problem.project(one.joint)), problem.rng()).significant:
            continue  # all other effects are already in the fit, so only noise may be left
        tried = StepwiseSearch(problem, families, one).run()
        if tried.joint.choices and _leaves_noise(problem, tried):
            return tried
    return found


def _leaves_noise(problem: Problem, found: SearchResult) -> bool:
    """Return True if a result leaves only noise."""
    is_open = found.alternatives or found.formulas or found.outside_library
    return not is_open and not detect(found.final, problem.rng()).significant


def _with_background(problem: Problem, families: Collection[str], found: SearchResult) -> SearchResult:
    """Return a result with the effects that are certain given a background of unexplained structure.

    Args:
        problem: the data.
        families: families of effects that may be named.
        found: the result without a background. Its effects are kept if it leaves only noise, or if no effect is certain
            given a background.
    """
    names, formulas = _names(problem, families, found)
    known = found.joint.choices if names is None else names.joint.choices or found.joint.choices
    is_path = follows_path(problem.solution.samples)  # drift along a path imitates causes too
    of_cause = None if is_path else names_given_cause(problem, families, known, is_open=names is not None)
    names, formulas = (names, formulas) if of_cause is None else (of_cause, ())
    is_doubted = is_path and names is not None
    if names is None or not (names.joint.choices or of_cause or is_doubted):
        smooth = None if formulas else names
        return replace(found, evidence=evidence_alone(problem, found.joint, families), given_background=smooth)
    joint, first = names.joint, found.steps[0]
    last = problem.project(joint)
    posterior = {name: own.posterior for name, own in names.evidence.items()}
    of_family = by_family(names.left) | {c.family: posterior[str(c)] for c in joint.choices}
    listed = ", ".join(map(str, joint.choices))
    reason = (
        f"the data require {listed}, whatever else is present" if listed else "nothing is certain in addition to drift"
    )
    return SearchResult(
        problem,
        adopted(problem.solution, joint, reason),
        joint,
        (
            replace(first, adopted=joint.choices, posterior=of_family),
            replace(first, fit=joint, projection=last, scored=names.left, posterior=of_family, adopted=(), reasons={}),
        ),
        names.open_set,
        formulas,
        formulas,
        posterior,
        found.candidates,
        found.initial,
        Grammar(last),
        names.evidence,
        names,
    )


def _names(
    problem: Problem, families: Collection[str], found: SearchResult
) -> tuple[Names | None, tuple[Formula, ...]]:
    """Return the names given a background of unexplained structure, or None if the search left only noise.

    An effect outside the library is described by one or a few formulas that leave only noise. The names are then found
    given these formulas, which are returned too. If formulas do not explain all residuals, their meaning is uncertain,
    and the names are found given a smooth background instead.
    """
    known, context, average = found.joint.choices, found.joint.context, problem.solution.samples.average
    smooth = smooth_blocks(context, average)
    if follows_path(problem.solution.samples):
        # Drift with time resembles any effect whose pattern changes slowly along a path.
        drifting = [*(block for block in smooth if block.kind != "time"), *time_blocks(context, average, fine=True)]
        return names_given_background(problem, drifting, families, known), ()
    final = found.final
    if found.alternatives:  # one of them exists, so its part is explained
        tried = problem.fit([*known, found.alternatives[0].choice], found.joint.fit.x)
        final = Grammar(problem.project(tried))
    if not found.outside_library and not detect(final, problem.rng()).significant:
        if found.alternatives or len(problem.solution.samples) < _LEAST_SAMPLES:
            return None, ()
        wide = [*smooth, *displacement_blocks(context, average)]
        if background_log_bayes_factor(problem, found.joint, wide) < STRUCTURE:
            return None, ()
        names = names_given_background(problem, smooth, families, known)
        left = background_log_bayes_factor(problem, names.joint, wide)
        return replace(names, background_log_bayes_factor=left), ()
    if not found.needs_background and formulas_suffice(problem, found.joint, found.strongest_formula):
        further, formulas = found.strongest_formula, tuple[Formula, ...]()
        for number in range(MOST_FORMULAS):
            new = tuple(f for f in further if not is_in_library(f, found.candidates.candidates, found.initial))
            if number and not new:  # the remaining formulas are library effects, which were already tried given these
                break
            formulas += new
            names = names_given_background(
                problem, [formula_block(f, n) for n, f in enumerate(formulas)], families, known
            )
            further = residual_formula(problem, names.joint, formulas)
            if not further:
                return names, formulas
    return names_given_background(problem, smooth, families, known, lambda: possible_blocks(context, average)), ()
