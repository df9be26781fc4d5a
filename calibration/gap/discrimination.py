"""Proposals that tell effects apart which these data cannot: poses, and experiments that are no poses.

Which experiment separates two effects follows from what they do. A condition (the side a joint comes from, the load,
the dwell ...) is tried on paper: the effects whose displacements change with it stand apart from those that it leaves
as they are. So do effects that sit before and behind a place on the boom where a prism can be put.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calibration.design.alternatives import alternative_of, changing, conditions_of, name_of
from calibration.design.candidates import Candidates, draw, near
from calibration.design.conditions import instructions
from calibration.design.exchange import Integers
from calibration.design.knowledge import Knowledge, setup_of
from calibration.design.planning import pose_rows
from calibration.design.poses import Plan, plan
from calibration.design.visibility import site
from calibration.effects.boom import boom_of
from calibration.effects.fitted import FittedEffect
from calibration.effects.library import library
from calibration.errors import DataError, UnsafeError
from calibration.gap.criteria import NEAR
from calibration.gap.result import Experiment
from calibration.model.model import CalibratedModel
from calibration.observations import Observations
from calibration.rig.description import Rig

POSES = 20
_CANDIDATES = 4000
_PAUSE_S = 600.0  # between the last fix and the first new one
_KINDS = {
    "payload_kg": "payload",
    "temperature_degC": "temperature",
    "time_s": "repeat",
    "dwell_s": "dwell",
    "_bar": "pressure",
    "_rate": "motion",
    "_dir": "approach",
}
_ORDERS = {
    "payload": "Go to the same poses with and without a payload",
    "temperature": "Go to the same poses when it is cold and when it is warm",
    "repeat": "Come back to the first poses hours later, with nothing moved but the boom",
    "dwell": "Stand in one pose and measure again and again for some minutes",
    "motion": "Take fixes on the move, there and back along one path, and then with the boom stopped on it",
}


def propose_experiments(
    model: CalibratedModel,
    observations: Observations,
    answers: Sequence[Sequence[FittedEffect]],
    rng: np.random.Generator,
    *,
    poses: int = POSES,
) -> tuple[Experiment, ...]:
    """Propose what to measure next to tell a set of effects apart.

    Args:
        model: kinematics, and effects that are beyond doubt; those of the set are none of these.
        observations: the rows that it was calibrated with.
        answers: two or three, each an effect as it was found by itself, and then other forms and places of its family
            that may be what it is.
        rng: draws the poses among which the best are chosen.
        poses: how many to propose.

    Returns:
        The poses first, for the prisms that were measured before; none where the rig can take too few, or where poses
        show none of the alternatives.
    """
    knowledge, alternatives = Knowledge.before(model, setup_of(model)), [first for first, *_ in answers]
    try:
        at = site(model.chain, model.values, setup=knowledge.setup)
        begin_s, payload_kg = _end_s(observations), _heaviest_kg(observations)
        drawn = draw(knowledge, at, rng, max(_CANDIDATES, poses), begin_s=begin_s, payload_kg=payload_kg)
    except UnsafeError:
        return (*_by_place(model.rig, alternatives), *_as_the_library_says(alternatives))
    candidates = _with_prisms(drawn, [bool(model.coverage.fixes.get(n)) for n in model.rig.prism_names])
    tried = drawn.few()
    return (
        *_poses(knowledge, candidates, observations, answers, poses, partial(near, knowledge, at, rng)),
        *_by_condition(knowledge, tried, alternatives),
        *_by_place(model.rig, alternatives),
        *_as_the_library_says(alternatives),
    )


def _with_prisms(candidates: Candidates, measured: Sequence[bool]) -> Candidates:
    """Return the candidates from which at least one measured prism is visible, without the other prisms."""
    seen = candidates.seen & np.array(measured)
    return replace(candidates, seen=seen).select(np.flatnonzero(seen.any(axis=1)))


def _poses(
    knowledge: Knowledge,
    candidates: Candidates,
    observations: Observations,
    answers: Sequence[Sequence[FittedEffect]],
    count: int,
    nearby: Callable[[Candidates], tuple[Candidates, Integers]],
) -> Iterator[Experiment]:
    few = candidates.few()
    shown = [[effect for effect in answer if _is_shown(knowledge, few, effect)] for answer in answers]
    told = [answer for answer in shown if answer]
    if not told or len(candidates) < count:
        return
    chosen = plan(knowledge, candidates, count, separate=told, measured=observations, nearby=nearby)
    rows = tuple(row.as_dict() for row in pose_rows(knowledge.chain.rig, chosen.poses))
    setups = knowledge.chain.setups
    here = f" at set-up {setups[knowledge.setup]!r}" if len(setups) > 1 else ""
    orders = "".join(f"; {order}" for order in instructions(knowledge.chain.rig, chosen.poses.conditions))
    yield Experiment(
        "poses", f"Measure {count} poses{here} chosen for it: {_promise(chosen)}{orders}", rows, chosen.stands_out
    )


def _is_shown(knowledge: Knowledge, poses: Candidates, alternative: FittedEffect) -> bool:
    """True if poses, and conditions that an operator can bring about, show anything of an effect."""
    try:
        names = conditions_of(knowledge, name_of(alternative), poses.readings, poses.conditions)
        there = poses.under(names)
        alternative_of(knowledge, alternative, there.readings, there.conditions)
    except DataError:
        return False
    return True


def _promise(chosen: Plan) -> str:
    """Return a clause: by how much each is expected to stand out, and whether that is enough to name it."""
    each = [f"{name} by {sigma:.1f} sigma" for name, sigma in chosen.stands_out.items()]
    text = f"if it is there, what is left of it that the others cannot explain will stand out: {', '.join(each)}"
    unsure = [name for name, sigma in chosen.stands_out.items() if 0.5 * sigma**2 < NEAR]
    if unsure:
        text += f"; that may be too little to name {_listed(unsure)}, and takes more such poses or another experiment"
    return text


def _by_condition(
    knowledge: Knowledge, poses: Candidates, alternatives: Sequence[FittedEffect]
) -> Iterator[Experiment]:
    """Yield the conditions that change what some of the alternatives do and not what the others do."""
    for kind, concerned in changing(knowledge, alternatives, poses.readings, poses.conditions).items():
        if 0 < len(concerned) < len(alternatives):
            others = [name for name in map(name_of, alternatives) if name not in concerned]
            name = next(value for end, value in _KINDS.items() if kind[0].endswith(end))
            order, changes, leaves = _order(name, kind[0]), _listed(concerned), _listed(others)
            yield Experiment(name, f"{order}: what {changes} does changes by it, what {leaves} does not")


def _by_place(rig: Rig, alternatives: Sequence[FittedEffect]) -> Iterator[Experiment]:
    """Yield control points, for effects of the station and of the base, and a prism between two places."""
    names = [name_of(alternative) for alternative in alternatives]
    station = [name_of(r) for r in alternatives if r.where == "station" or r.where in rig.prism_names]
    base = [name_of(r) for r in alternatives if r.where == "base"]
    if 0 < len(station) < len(names):
        yield Experiment(
            "control_points",
            f"Measure control points on the ground, near and far and all round: {_listed(station)} shows there if the "
            f"target is the same, {_listed([n for n in names if n not in station])} does not",
        )
    if 0 < len(base) < len(names):
        yield Experiment(
            "control_points",
            f"Measure control points and a prism on the carrier before, between and after the poses: {_listed(base)} "
            f"moves the one and not the others, {_listed([n for n in names if n not in base])} moves neither",
        )
    rows = sorted((row, r.where, name_of(r)) for r in alternatives if (row := _row(rig, r.where)) is not None)
    if rows and rows[0][0] < rows[-1][0]:
        (first, _, before), (last, where, behind) = rows[0], rows[-1]
        boom = _row(rig, "boom")
        frame, place = last - 1, f"on the link before {where}"
        if where == "boom":
            place = "at the root of the boom"
        elif boom is not None and first <= boom < last:
            frame, place = boom, "at the head of the boom"
        yield Experiment(
            "prism",
            f"Put a prism {place} (frame {frame}) and measure it in the same poses: {before} moves it, {behind} does "
            f"not",
        )


def _row(rig: Rig, where: str) -> int | None:
    """Return the first row that an effect at a joint value, a passive row or the boom moves; None for all others."""
    if where == "boom":
        boom = boom_of(rig)
        return None if boom is None else boom[0]
    return next((number for number, _, name, _ in rig.couplings() if where in (name, f"row{number}")), None)


def _as_the_library_says(alternatives: Sequence[FittedEffect]) -> Iterator[Experiment]:
    for alternative in alternatives:
        yield Experiment(
            "procedure", f"To see {name_of(alternative)} by itself: {library()[alternative.family].revealed_by}"
        )


def _order(kind: str, column: str) -> str:
    if kind == "approach":
        return f"Come to the same poses with {column.removesuffix('_dir')} once from below and once from above"
    if kind == "pressure":
        return f"Go to the same poses with {column} high and low, by the load or by what the boom pushes against"
    return _ORDERS[kind]


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names)


def _end_s(observations: Observations) -> float:
    times = observations.extra.get("time_s", np.empty(0))
    return float(np.nanmax(times)) + _PAUSE_S if np.isfinite(times).any() else 0.0


def _heaviest_kg(observations: Observations) -> float:
    carried = observations.extra.get("payload_kg", np.empty(0))
    return float(np.nanmax(carried, initial=0.0))
