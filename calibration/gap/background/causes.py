"""Causes that the library lacks, and that effects of it imitate: a drift, an event, and links that give way to loads.

What happens at one instant has one cause: where the library lacks it, steps of something else at that instant imitate
it, each beyond doubt. So do steps at any instants of what changes steadily. Likewise a link that gives way in a way of
its own is imitated by others. Such effects are not named where a cause of that kind, whatever it is in particular,
explains everything without them.
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
from calibration.gap.background.blocks import Block, drift_block, elastic_blocks, event_blocks
from calibration.gap.background.naming import Names, names_beside
from calibration.gap.background.outside import grammar_beside
from calibration.gap.background.search import ODDS_OF_TWO, grown, joint_beside, linear_system, system_beside
from calibration.gap.background.widening import further_blocks
from calibration.gap.detection import FAR, Detection, detect
from calibration.gap.joint_fit import JointFit, Problem

_APART = 4.0  # standard deviations of instants
_MOST = 2  # events that may explain all
_MORE = 15.0  # log Bayes factor of a cause against the effects that imitate it
_ANY_SIZE = 10.0  # factor on plausible sizes


def names_beside_cause(
    problem: Problem, families: Collection[str], known: Sequence[Choice], *, is_open: bool
) -> Names | None:
    """Return what is named beside an event, a drift or yielding links in general, which effects of the library imitate.

    Args:
        problem: the data.
        families: of effects that may be named.
        known: effects that were found without it.
        is_open: they leave more than noise.

    Returns:
        None where no effect imitates such a cause, or where more is left.
    """
    steps = [choice for choice in known if _is_step(choice)]
    if steps and (is_open or _coincide(steps)):
        for cause_of in (_drift, _event):
            cause, imitating = cause_of(problem, known, steps)
            names = _names(problem, families, known, imitating, cause)
            if names is not None:
                return _without_parts(problem, names)
    yielding = [choice for choice in known if library()[choice.family].goes_with]
    if yielding and is_open:
        cause, imitating = _links(problem, known, yielding)
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
    """Return the names beside a cause in place of what imitates it; None where nothing does, or more is left."""
    others = [choice for choice in known if choice not in imitating]
    if not imitating or _left(problem, problem.fit(others, problem.solution.fit.x), cause).p < FAR:
        return None
    names = names_beside(problem, cause, families, others)
    return None if _left(problem, names.joint, cause).significant else names


def _left(problem: Problem, joint: JointFit, blocks: Sequence[Block]) -> Detection:
    """Test whether more than noise is left when blocks are fitted along with kinematics and effects."""
    columns = joined([block.columns for block in blocks], len(problem.solution.samples))
    columns = replace(columns, prior_sigma=_ANY_SIZE * columns.prior_sigma)
    return detect(grammar_beside(problem, joint, columns), problem.rng())


class _Evidence:
    """Log evidence of some of the known effects beside some blocks, by weights that count beside all of them."""

    def __init__(self, problem: Problem, known: Sequence[Choice], blocks: Sequence[Block]) -> None:
        self._system, effects, _ = system_beside(problem, blocks, known)
        self._effects = dict(zip(map(str, known), effects, strict=True))

    def of(self, choices: Sequence[Choice], without: Collection[Block] = ()) -> float:
        """Return the log evidence of effects beside all blocks but some."""
        effects = [self._effects[str(choice)] for choice in choices]
        return self._system.fit(effects, None, without={block.name for block in without}).log_evidence


def _drift(
    problem: Problem, known: Sequence[Choice], steps: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return the drift that the errors ask for in place of steps, and the steps that it makes superfluous."""
    context = problem.kinematics_only().situation
    drift = drift_block(context, problem.solution.samples.average, context.extra("time_s"))
    evidence = _Evidence(problem, known, [drift])
    whole = evidence.of(known)
    imitating = [step for step in steps if whole - evidence.of([c for c in known if c is not step]) < ODDS_OF_TWO]
    without = [choice for choice in known if choice not in imitating]
    is_asked_for = evidence.of(without) - evidence.of(known, [drift]) > _MORE
    return ([drift], imitating) if is_asked_for else ((), ())


def _event(
    problem: Problem, known: Sequence[Choice], steps: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return the events that the errors ask for in place of steps, and the steps that are parts of them."""
    kinematics, average = problem.with_mild_outliers(problem.kinematics_only()), problem.solution.samples.average
    others = [choice for choice in known if choice not in steps]
    system, begun = linear_system(problem, kinematics, (), (), others)
    instants_s = [step.settings["time_s"] for step in steps]
    model = system.fit(system.chosen(begun), None)
    events = further_blocks(system, model, lambda: event_blocks(kinematics.situation, average, instants_s))
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
    problem: Problem, known: Sequence[Choice], yielding: Sequence[Choice]
) -> tuple[Sequence[Block], Sequence[Choice]]:
    """Return links that give way to loads, and the effects of loads for which any of the other links does as well.

    The links at the places of effects that are there in their own right are left out: they could do the same.
    """
    links = elastic_blocks(problem.kinematics_only().situation, problem.solution.samples.average)
    if not links:
        return (), ()
    evidence, imitating, alike = _Evidence(problem, known, links), list[Choice](), set[str]()
    for choice in yielding:
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
    """True if a cause is plainly more probable than what imitates it along with all that the library has beside that.

    Links that give way in general can do whatever effects of loads do, also where the library has all of these: they
    are not asked for then.
    """
    if not imitating:
        return False
    joint, scales = joint_beside(problem, cause, known)
    others = [choice for choice in known if choice not in imitating]
    beside, effects = linear_system(problem, joint, cause, (), others)
    alone, begun = linear_system(problem, joint, (), families, known)
    of_library = grown(alone, alone.fit(alone.chosen(begun), None))
    return beside.fit(beside.chosen(effects), scales).log_evidence - of_library.log_evidence > _MORE


def _without_parts(problem: Problem, names: Names) -> Names:
    """Return names without the steps at whose instant more has happened."""
    parts = [step for step in names.joint.choices if _is_part(step, names.events)]
    if not parts:
        return names
    kept = [choice for choice in names.joint.choices if choice not in parts]
    evidence = {str(choice): names.evidence[str(choice)] for choice in kept}
    return replace(names, joint=problem.fit_part(names.joint, kept), evidence=evidence)


def _coincide(steps: Sequence[Choice]) -> bool:
    """Return True if several steps may have happened at the same time."""
    every = sorted((step.settings["time_s"], step.settings["time_error_s"]) for step in steps)
    return any(later - at <= _APART * math.hypot(a, b) for (at, a), (later, b) in itertools.pairwise(every))


def _is_part(choice: Choice, events: Sequence[Block]) -> bool:
    """Return True for a step that may have happened at the instant of an event."""
    if not _is_step(choice):
        return False
    apart = _APART * choice.settings["time_error_s"]
    return any(abs(choice.settings["time_s"] - event.since_s) <= apart for event in events)


def _is_step(choice: Choice) -> bool:
    return isinstance(library()[choice.family], StepFamily)
