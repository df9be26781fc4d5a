"""What a search has found, as far as it closes the gap and is no part of something else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from calibration.effects.fitted import Choice
from calibration.gap.adequacy import closes, depends
from calibration.gap.adopt import Adopted, JointFit, adopted
from calibration.gap.detect import detect
from calibration.gap.grammar import Found as Formula
from calibration.gap.grammar import Grammar
from calibration.gap.problem import Problem
from calibration.gap.projection import Projection
from calibration.gap.screen import Possible, Weighed


@dataclass(frozen=True)
class Turn:
    """One turn of the loop.

    Attributes:
        fit: kinematics and effects at its beginning.
        projection: about that fit.
        weighed: all places, the most probable first.
        posterior: family -> probability that it is there.
        taken: what it took in to stay: one effect, at one place or several; none in the last.
        reasons: `family@where` -> why it was not named, a clause.
    """

    fit: JointFit
    projection: Projection
    weighed: tuple[Weighed, ...]
    posterior: Mapping[str, float]
    taken: tuple[Choice, ...]
    reasons: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """The result of the search.

    Attributes:
        adopted: kinematics and effects.
        joint: their fit.
        turns: in their order, the last without anything taken in.
        rivals: of the set that is pending, the most probable first; none where nothing is.
        formulas: of the grammar, where they explain better than all of the library what is left.
        strange: of the grammar, what beat the library beside all that had been named by then, even if that was taken
            back; `formulas` by default.
        certain: `family@where` of what is adopted -> posterior of its family when it was.
        possible: all places at the beginning, and what the data lack for others.
        first: what the kinematics alone leave.
        left: what is left in the end, and all terms that it may depend on.
    """

    adopted: Adopted
    joint: JointFit
    turns: tuple[Turn, ...]
    rivals: tuple[Weighed, ...]
    formulas: tuple[Formula, ...]
    strange: tuple[Formula, ...]
    certain: Mapping[str, float]
    possible: Possible
    first: Projection
    left: Grammar


def concluded(
    problem: Problem,
    joint: JointFit,
    alone: Turn,
    turns: Sequence[Turn],
    rivals: tuple[Weighed, ...],
    formulas: tuple[Formula, ...],
    certain: Mapping[str, float],
    first: Possible,
) -> Found:
    """What is found, as far as it is no part of something else.

    Args:
        problem: the data.
        joint: kinematics with all that was taken in.
        alone: kinematics alone.
        turns: in their order.
        rivals: of the set that is pending.
        formulas: that explain better than all of the library what is left.
        certain: posterior of the family of what was taken in.
        first: all places at the beginning.
    """
    solution = problem.solution
    rivals = rivals if _may_close(problem, alone.projection, joint, rivals) else ()
    joint, against = _whole(problem, joint, rivals)
    last = problem.project(joint) if joint.choices else alone.projection
    left, strange = Grammar(last), formulas
    if against and not rivals:
        formulas = left.found()
    turns = _as_they_count(problem, turns, alone, joint, against)
    turns[-1] = replace(turns[-1], fit=joint, projection=last)
    if joint.choices and not rivals and not _closes(problem, turns[0].projection, left, is_structured=bool(formulas)):
        return _retracted(problem, turns, strange or formulas, first)
    taken = Adopted(solution, solution.fit, reason="nothing stands out of the noise that could be named")
    if joint.choices:
        taken = adopted(solution, joint, f"the data ask for {', '.join(map(str, joint.choices))}")
    posterior = {str(c): certain[str(c)] for c in joint.choices}
    return Found(
        taken,
        joint,
        tuple(turns),
        rivals,
        formulas,
        strange or formulas,
        posterior,
        first,
        turns[0].projection,
        left,
    )


def _may_close(problem: Problem, first: Projection, joint: JointFit, rivals: Sequence[Weighed]) -> bool:
    """Whether the gap closes with the most probable of a set: a set is held to what a name is held to."""
    if not rivals:
        return False
    tried = problem.fit([*joint.choices, rivals[0].choice], joint.fit.x)
    return _closes(problem, first, Grammar(problem.project(tried)), is_structured=False)


def _closes(problem: Problem, first: Projection, left: Grammar, *, is_structured: bool) -> bool:
    """Whether what is left is little beside the first gap; `is_structured`: it is known to depend on something."""
    structured = is_structured or detect(left, problem.rng()).significant
    return closes(first, left.projection, problem.solution.fit.weight, is_structured=structured)


def _whole(problem: Problem, joint: JointFit, rivals: Sequence[Weighed]) -> tuple[JointFit, dict[str, str]]:
    """The fit without effects that are a part of something else; `family@where` of those -> why, a clause."""
    if not joint.choices:
        return joint, {}
    # Where one of several is there, but nobody knows which, the most probable one is.
    tried = problem.fit([*joint.choices, rivals[0].choice], joint.fit.x) if rivals else joint
    over = problem.project(tried)
    found = {str(c): depends(tried, n, over, problem.rng()) for n, c in enumerate(joint.choices)}
    against = {name: f"its size would depend on {text}" for name, text in found.items() if text}
    if not against:
        return joint, {}
    kept = [c for c in joint.choices if str(c) not in against]
    return problem.fit(kept, joint.start(kept)), against


def _as_they_count(
    problem: Problem,
    turns: Sequence[Turn],
    alone: Turn,
    last: JointFit,
    against: Mapping[str, str],
) -> list[Turn]:
    """The turns without what was there for the time being, each about a fit of what those before it took in.

    Args:
        problem: the data.
        turns: in their order.
        alone: kinematics alone.
        last: what is there in the end.
        against: `family@where` -> why it is not, a clause; what was found after it by default.
    """
    kept, there, out = {str(c) for c in last.choices}, set[str](), []
    for turn in turns:
        taken = tuple(c for c in turn.taken if str(c) in kept)
        dropped = {
            str(c): against.get(str(c), "what was found after it makes it superfluous")
            for c in turn.taken
            if c not in taken
        }
        own = [c for c in turn.fit.choices if str(c) in there]
        fit, projection = turn.fit, turn.projection
        if not own:
            fit, projection = alone.fit, alone.projection
        elif len(own) < len(fit.choices):
            fit = problem.fit(own, fit.start(own))
            projection = problem.project(fit)
        out.append(replace(turn, fit=fit, projection=projection, taken=taken, reasons={**turn.reasons, **dropped}))
        there |= {str(c) for c in taken}
    return out


def _retracted(problem: Problem, turns: Sequence[Turn], formulas: tuple[Formula, ...], first: Possible) -> Found:
    """No effect at all: what the library has explains a part of the gap only, so it is something else."""
    reasons = {str(c): "it closes a part of the gap only" for turn in turns for c in turn.taken}
    turn = replace(turns[0], taken=(), reasons={**turns[0].reasons, **reasons})
    start, solution = turns[0].projection, problem.solution
    left = Grammar(start)
    return Found(
        Adopted(solution, solution.fit, reason="what could be named closes a part of the gap only"),
        turn.fit,
        (turn,),
        (),
        left.found() or formulas,
        formulas or left.found(),
        {},
        first,
        start,
        left,
    )
