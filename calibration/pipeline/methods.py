"""Registry of the methods to identify a rig: the default and those of two published papers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.effects.context import EffectContext
from calibration.effects.library import library, parse_effects
from calibration.gap.adoption import Adopted, adopt
from calibration.gap.search import search
from calibration.gap.search_result import Remaining, remaining
from calibration.gap.unknown_inputs import (
    filled_in,
    unknowns_of_any_size,
    with_unknowns,
    without_unknowns,
)
from calibration.identification.checks import refuse_much_discarded
from calibration.identification.refinement import Prior
from calibration.identification.solve import Solution, solve
from calibration.observations import Observations
from calibration.published.first_paper import pde_paper
from calibration.published.second_paper import km, require_torques, skcm
from calibration.residual.selection import Kind
from calibration.rig.description import Rig
from calibration.run_settings import Run


@dataclass(frozen=True)
class Task:
    """A task to identify a rig from observations.

    Attributes:
        rig: the rig description.
        observations: rows with positions.
        prior: trust the build tolerances, or estimate their scale.
        effects: `auto`, `none` or FAMILY@WHERE,...
        run: seed, workers, progress and checkpoint.
    """

    rig: Rig
    observations: Observations
    prior: Prior
    effects: str
    run: Run


@dataclass(frozen=True)
class Method:
    """A method to identify a rig.

    Attributes:
        identify: function that fits kinematics and effects.
        residual: default learner of the residual.
        takes_effects: whether effects may be requested by name.
    """

    identify: Callable[[Task], Adopted]
    residual: Kind | Literal["torque network"] = "none"
    takes_effects: bool = False


def find_effects(
    rig: Rig,
    observations: Observations,
    families: Collection[str],
    prior: Prior,
    run: Run,
    rng: np.random.Generator,
) -> Remaining:
    """Solve the kinematics, search for missing effects, and test the remaining errors.

    Args:
        rig: the rig description.
        observations: rows with positions.
        families: families of effects that may be named.
        prior: trust the build tolerances, or estimate their scale.
        run: seed, workers, progress and checkpoint.
        rng: generator for the signs in the last test.

    Raises:
        DataError, UnsafeError: as `solve`; also UnsafeError if kinematics with effects leave out much of the data.
    """
    solution = solve(rig, observations, prior=prior, run=run.part(0.0, 0.4))
    run.progress(0.4, "looking for missing effects")
    found = search(solution, observations, families, prior=prior, seed=run.seed)
    refuse_much_discarded(solution.chain, solution.samples, found.adopted.solution.fit)
    run.progress(0.9, "testing the remaining errors")
    return remaining(found, rng)


def effects_rng(seed: int) -> np.random.Generator:
    """Return the generator for `find_effects` and for the processing of its result."""
    return np.random.default_rng([seed, 1])


def identify_by(method: str, task: Task) -> Adopted:
    """Fit kinematics and effects by one of `METHODS`.

    Raises:
        ValueError: the method or an effect is unknown, or the method takes no effects.
        DataError: the method cannot use the data.
        UnsafeError: the method refuses the data.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not available; available: {', '.join(METHODS)}")
    chosen = METHODS[method]
    if not chosen.takes_effects and task.effects not in ("auto", "none"):
        raise ValueError(f"method {method!r} takes no effects; leave {task.effects!r} out, or use the default method")
    if task.effects not in ("auto", "none"):
        parse_effects(task.effects, task.rig)  # report a wrong name before the slow search
    return chosen.identify(task)


def _default(task: Task) -> Adopted:
    rig, observations, prior, run = task.rig, task.observations, task.prior, task.run
    if task.effects == "auto":
        rest = find_effects(rig, observations, library(), prior, run, effects_rng(run.seed))
        return replace(rest.adopted, warnings=(*rest.adopted.warnings, *rest.warnings()))
    solution = solve(rig, observations, prior=prior, run=run.part(0.0, 0.8))
    found = _requested(task, solution)
    refuse_much_discarded(solution.chain, solution.samples, found.solution.fit)
    return found


def _requested(task: Task, solution: Solution) -> Adopted:
    """Return the effects that a task names, with unknowns of any size for samples that lack inputs of these effects."""
    rows = filled_in(task.observations, solution.samples)
    context = EffectContext(solution.chain, solution.fit.x, rows)
    names = () if task.effects == "none" else parse_effects(task.effects, task.rig)
    unknowns = unknowns_of_any_size(names, context, solution.samples)
    if unknowns is None:
        return adopt(solution, rows, task.effects, prior=task.prior)
    given = with_unknowns(solution, unknowns, task.prior)
    return without_unknowns(adopt(given, rows, task.effects, prior=task.prior), solution.samples, unknowns)


def _pde_paper(task: Task) -> Adopted:
    return _without_effects(pde_paper(task.rig, task.observations, prior=task.prior, run=task.run))


def _km(task: Task) -> Adopted:
    return _without_effects(km(task.rig, task.observations, task.run))


def _skcm(task: Task) -> Adopted:
    return skcm(task.rig, task.observations, task.run)


def _rbf_tcm(task: Task) -> Adopted:
    require_torques(task.rig, task.observations, "rbf-tcm")
    return _km(task)


def _without_effects(solution: Solution) -> Adopted:
    return Adopted(solution, solution.fit, reason="the method has none of its own")


METHODS: Mapping[str, Method] = {
    "default": Method(_default, residual="default", takes_effects=True),
    "pde-paper": Method(_pde_paper, residual="chain"),
    "km": Method(_km),
    "skcm": Method(_skcm),
    "rbf-tcm": Method(_rbf_tcm, residual="torque network"),
}
