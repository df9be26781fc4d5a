"""Causes outside the library that effects of the library imitate: a drift, an event, and compliant links.

Changes at one instant have one cause. If the library lacks this cause, several step effects at the same instant can
imitate it, each with strong evidence. Steps at several instants can likewise imitate a steady drift, and compliances of
other links can imitate a link that deflects in an unknown way. Such effects are not named if a general cause of this
kind explains the data without them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from calibration.effects.columns import joined
from calibration.effects.families.base_compliance import BaseCompliance
from calibration.effects.fitted import Choice
from calibration.effects.library import library
from calibration.effects.timing import StepFamily
from calibration.gap.background.blocks import Block, drift_block, elastic_blocks, event_blocks, times_or_order
from calibration.gap.background.naming import Names, names_given_background
from calibration.gap.background.outside import grammar_of_residuals
from calibration.gap.background.search import (
    ODDS_OF_TWO,
    add_certain_effects,
    kinematics_given_effects,
    linear_system,
    system_given_effects,
)
from calibration.gap.background.widening import further_blocks
from calibration.gap.detection import FAR, Detection, detect
from calibration.gap.joint_fit import JointFit, Problem

_APART = 4.0  # standard deviations within which two instants may be the same
_MOST = 2  # largest number of events
_MORE = 15.0  # log Bayes factor required of a cause against the effects that imitate it
_ANY_SIZE = 10.0  # factor on plausible sizes to allow almost any amplitude


def names_given_cause(
    problem: Problem, families: Collection[str], known: Sequence[Choice], *, is_open: bool
) -> Names | None:
    """Return the names given a general event, drift or link compliance that effects of the library imitate.

    Args:
        problem: the data.
        families: families of effects that may be named.
        known: effects that were found without such a cause.
        is_open: True if these effects leave more than noise.

    Returns:
        The names; None if no effect imitates such a cause, or if the cause leaves more than noise.
    """
    steps = [choice for choice in known if _is_step(choice)]
    if steps and (is_open or _coincide(steps)):
        for cause_of in (_drift, _event):
            cause, imitating = cause_of(problem, known, steps)
            names = _names(problem, families, known, imitating, cause)
            if names is not None:
                return _without_parts(problem, names)
    compliant = [choice for choice in known if library()[choice.family].load_kind]
    if compliant and is_open:
        cause, imitating = _links(problem, known, compliant)
        if _explains_more(problem, cause, families, known, imitating):
            return _names(problem, families, known, imitating, cause)
    return None


def _names(
    problem: Problem,
    families: Collection[str],
    known: Sequence[Choice],
    imitating: Sequence[Choice],
    cause: Sequence[Block],
) -> Names | None:
    """Return the names given a cause that replaces its imitations; None without imitations or if structure remains."""
    others = [choice for choice in known if choice not in imitating]
    if not imitating or _left(problem, problem.fit(others, problem.solution.fit.x), cause).p < FAR:
        return None
    names = names_given_background(problem, cause, families, others)
    return None if _left(problem, names.joint, cause).significant else names


def _left(problem: Problem, joint: JointFit, blocks: Sequence[Block]) -> Detection:
    """Test for structure in the residuals when blocks are fitted together with kinematics and effects."""
    columns = joined([block.columns for block in blocks], len(problem.solution.samples))
    columns = replace(columns, prior_sigma=_ANY_SIZE * columns.prior_sigma)
    return detect(grammar_of_residuals(problem, joint, columns), problem.rng())


class _Evidence:
    """Log evidence of subsets of known effects and blocks, with the outlier weights of the full model."""

    def __init__(self, problem: Problem, known: Sequence[Choice], blocks: Sequence[Block]) -> None:
        self._system, effects, _ = system_given_effects(problem, blocks, known)
        self._effects = dict(zip(map(str, known), effects, strict=True))

    def of(self, choices: Sequence[Choice], without: Collection[Block] = ()) -> float:
        """Return the log evidence of effects together with all blocks except those in `without`."""
        effects = [self._effects[str(choice)] for choice in choices]
        return self._system.fit(effects, None, without={block.name for block in without}).log_evidence


def _drift(
    problem: Problem, known: Sequence[Choice], steps: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return the drift, if the data prefer it to steps, and the steps that it makes superfluous."""
    context = problem.kinematics_only().context
    drift = drift_block(context, problem.solution.samples.average, times_or_order(context))
    evidence = _Evidence(problem, known, [drift])
    whole = evidence.of(known)
    imitating = [step for step in steps if whole - evidence.of([c for c in known if c is not step]) < ODDS_OF_TWO]
    without = [choice for choice in known if choice not in imitating]
    is_asked_for = evidence.of(without) - evidence.of(known, [drift]) > _MORE
    return ([drift], imitating) if is_asked_for else ((), ())


def _event(
    problem: Problem, known: Sequence[Choice], steps: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return the events that the data require, and the steps that these events replace."""
    kinematics, average = problem.with_mild_outliers(problem.kinematics_only()), problem.solution.samples.average
    others = [choice for choice in known if choice not in steps]
    system, initial = linear_system(problem, kinematics, (), (), others)
    instants_s = [step.settings["time_s"] for step in steps]
    model = system.fit(system.chosen(initial), None)
    events = further_blocks(system, model, lambda: event_blocks(kinematics.context, average, instants_s))
    if len(events) > _MOST:
        return (), ()
    parts = {event.name: [step for step in steps if _is_part(step, [event])] for event in events}
    imitating = [step for own in parts.values() if len(own) > 1 for step in own]
    alone = [(event, parts[event.name][0]) for event in events if len(parts[event.name]) == 1]
    if alone:
        evidence = _Evidence(problem, known, events)
        for event, step in alone:
            without = [choice for choice in known if choice is not step]
            if evidence.of(without) - evidence.of(known, [event]) > _MORE:
                imitating.append(step)
    return events, imitating


def _links(
    problem: Problem, known: Sequence[Choice], compliant: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return blocks of compliant links, and the load effects that they make superfluous.

    The links at the places of the other load effects are left out, as they could imitate those effects.
    """
    links = elastic_blocks(problem.kinematics_only().context, problem.solution.samples.average)
    if not links:
        return (), ()
    evidence, imitating, alike = _Evidence(problem, known, links), list[Choice](), set[str]()
    for choice in compliant:
        own = [
            link
            for link in links
            if choice.where == link.where or (choice.where == BaseCompliance.place and link is links[0])
        ]
        without = [other for other in known if other is not choice]
        if evidence.of(known, own) - evidence.of(without, own) < ODDS_OF_TWO:
            imitating.append(choice)
        else:
            alike |= {link.name for link in own}
    return [link for link in links if link.name not in alike], imitating


def _explains_more(
    problem: Problem,
    cause: Sequence[Block],
    families: Collection[str],
    known: Sequence[Choice],
    imitating: Sequence[Choice],
) -> bool:
    """Return True if a cause is clearly more probable than its imitations with any further effects of the library.

    General link compliance can represent all load effects. It is not needed if the library has all of those present.
    """
    if not imitating:
        return False
    joint, scales = kinematics_given_effects(problem, cause, known)
    others = [choice for choice in known if choice not in imitating]
    given, effects = linear_system(problem, joint, cause, (), others)
    alone, initial = linear_system(problem, joint, (), families, known)
    of_library = add_certain_effects(alone, alone.fit(alone.chosen(initial), None))
    return given.fit(given.chosen(effects), scales).log_evidence - of_library.log_evidence > _MORE


def _without_parts(problem: Problem, names: Names) -> Names:
    """Return the names without steps that belong to an event."""
    parts = [step for step in names.joint.choices if _is_part(step, names.events)]
    if not parts:
        return names
    kept = [choice for choice in names.joint.choices if choice not in parts]
    evidence = {str(choice): names.evidence[str(choice)] for choice in kept}
    return replace(names, joint=problem.fit_part(names.joint, kept), evidence=evidence)


def _coincide(steps: Sequence[Choice]) -> bool:
    """Return True if two steps may have happened at the same instant."""
    every = sorted((step.settings["time_s"], step.settings["time_error_s"]) for step in steps)
    return any(later - at <= _APART * math.hypot(a, b) for (at, a), (later, b) in itertools.pairwise(every))


def _is_part(choice: Choice, events: Sequence[Block]) -> bool:
    """Return True if an effect is a step that may have happened at the instant of an event."""
    if not _is_step(choice):
        return False
    apart = _APART * choice.settings["time_error_s"]
    return any(abs(choice.settings["time_s"] - event.since_s) <= apart for event in events)


def _is_step(choice: Choice) -> bool:
    return isinstance(library()[choice.family], StepFamily)
