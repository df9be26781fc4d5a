"""Proposals to distinguish effects that the present data cannot distinguish: poses, and other experiments.

The experiment that separates two effects follows from their displacements. Each condition (direction of approach, load,
dwell, ...) is simulated. The effects whose displacements change with it can be distinguished from those that do not
change. A prism between two places on the machine likewise distinguishes effects before it from effects behind it.
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
_PAUSE_S = 600.0  # pause between the last fix and the first new one
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
    "repeat": "Return to the first poses hours later, with nothing moved but the boom",
    "dwell": "Stand still in one pose and measure repeatedly for some minutes",
    "motion": "Take fixes in motion, back and forth along one path, and then with the boom stopped on it",
}


def propose_experiments(
    model: CalibratedModel,
    observations: Observations,
    answers: Sequence[Sequence[FittedEffect]],
    rng: np.random.Generator,
    *,
    poses: int = POSES,
) -> tuple[Experiment, ...]:
    """Propose experiments that distinguish the effects of a set.

    Args:
        model: kinematics, and the effects that are certain, without those of the set.
        observations: the rows of the calibration.
        answers: two or three alternatives. Each is an effect fitted alone, followed by other possible variants and
            places of its family.
        rng: random generator for candidate poses.
        poses: number of poses to propose.

    Returns:
        The experiments. The first one proposes poses for the prisms measured before; it is left out if the rig can take
        too few poses, or if none of the alternatives is visible in poses.
    """
    knowledge, alternatives = Knowledge.before(model, setup_of(model)), [first for first, *_ in answers]
    try:
        at = site(model.chain, model.values, setup=knowledge.setup)
        begin_s, payload_kg = _end_s(observations), _heaviest_kg(observations)
        drawn = draw(knowledge, at, rng, max(_CANDIDATES, poses), begin_s=begin_s, payload_kg=payload_kg)
    except UnsafeError:
        return (*_by_place(model.rig, alternatives), *_by_library(alternatives))
    candidates = _with_prisms(drawn, [bool(model.coverage.fixes.get(n)) for n in model.rig.prism_names])
    tried = drawn.few()
    return (
        *_poses(knowledge, candidates, observations, answers, poses, partial(near, knowledge, at, rng)),
        *_by_condition(knowledge, tried, alternatives),
        *_by_place(model.rig, alternatives),
        *_by_library(alternatives),
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
    visible = [answer for answer in shown if answer]
    if not visible or len(candidates) < count:
        return
    chosen = plan(knowledge, candidates, count, separate=visible, measured=observations, nearby=nearby)
    rows = tuple(row.as_dict() for row in pose_rows(knowledge.chain.rig, chosen.poses))
    setups = knowledge.chain.setups
    here = f" at set-up {setups[knowledge.setup]!r}" if len(setups) > 1 else ""
    orders = "".join(f"; {order}" for order in instructions(knowledge.chain.rig, chosen.poses.conditions))
    yield Experiment(
        "poses",
        f"Measure {count} poses{here} chosen for it: {_expected_significance(chosen)}{orders}",
        rows,
        chosen.stands_out,
    )


def _is_shown(knowledge: Knowledge, poses: Candidates, alternative: FittedEffect) -> bool:
    """Return True if an effect is visible in poses under conditions that an operator can set."""
    try:
        names = conditions_of(knowledge, name_of(alternative), poses.readings, poses.conditions)
        there = poses.under(names)
        alternative_of(knowledge, alternative, there.readings, there.conditions)
    except DataError:
        return False
    return True


def _expected_significance(chosen: Plan) -> str:
    """Return a clause that states by how much each effect will stand out, and whether that is enough to name it."""
    each = [f"{name} by {sigma:.1f} sigma" for name, sigma in chosen.stands_out.items()]
    text = f"if an effect exists, the part that the others cannot explain will stand out: {', '.join(each)}"
    unsure = [name for name, sigma in chosen.stands_out.items() if 0.5 * sigma**2 < NEAR]
    if unsure:
        text += (
            f"; that may be too little to name {_listed(unsure)}, which needs more such poses or a different experiment"
        )
    return text


def _by_condition(
    knowledge: Knowledge, poses: Candidates, alternatives: Sequence[FittedEffect]
) -> Iterator[Experiment]:
    """Yield the conditions that change the displacements of some alternatives but not of others."""
    for kind, concerned in changing(knowledge, alternatives, poses.readings, poses.conditions).items():
        if 0 < len(concerned) < len(alternatives):
            others = [name for name in map(name_of, alternatives) if name not in concerned]
            name = next(value for end, value in _KINDS.items() if kind[0].endswith(end))
            order, changes, leaves = _order(name, kind[0]), _listed(concerned), _listed(others)
            yield Experiment(name, f"{order}: this changes the errors by {changes}, but not those by {leaves}")


def _by_place(rig: Rig, alternatives: Sequence[FittedEffect]) -> Iterator[Experiment]:
    """Yield control points for effects of station and base, and a prism between two places."""
    names = [name_of(alternative) for alternative in alternatives]
    station = [name_of(r) for r in alternatives if r.where == "station" or r.where in rig.prism_names]
    base = [name_of(r) for r in alternatives if r.where == "base"]
    if 0 < len(station) < len(names):
        yield Experiment(
            "control_points",
            f"Measure control points on the ground, near and far and in all directions: {_listed(station)} shows there "
            f"if the target is the same, {_listed([n for n in names if n not in station])} does not",
        )
    if 0 < len(base) < len(names):
        yield Experiment(
            "control_points",
            f"Measure control points and a prism on the carrier before, between and after the poses: {_listed(base)} "
            f"moves the prism and not the points, {_listed([n for n in names if n not in base])} moves neither",
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
    """Return the first row moved by an effect at a joint, a passive row or the boom; None for other places."""
    if where == "boom":
        boom = boom_of(rig)
        return None if boom is None else boom[0]
    return next((number for number, _, name, _ in rig.couplings() if where in (name, f"row{number}")), None)


def _by_library(alternatives: Sequence[FittedEffect]) -> Iterator[Experiment]:
    for alternative in alternatives:
        yield Experiment(
            "procedure", f"To see {name_of(alternative)} alone: {library()[alternative.family].revealed_by}"
        )


def _order(kind: str, column: str) -> str:
    if kind == "approach":
        return f"Approach the same poses with {column.removesuffix('_dir')} once from below and once from above"
    if kind == "pressure":
        return f"Go to the same poses with {column} high and low, by changing the load or by pushing against a stop"
    return _ORDERS[kind]


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names)


def _end_s(observations: Observations) -> float:
    times = observations.extra.get("time_s", np.empty(0))
    return float(np.nanmax(times)) + _PAUSE_S if np.isfinite(times).any() else 0.0


def _heaviest_kg(observations: Observations) -> float:
    carried = observations.extra.get("payload_kg", np.empty(0))
    return float(np.nanmax(carried, initial=0.0))
