"""One case, analysed: what a worker process does. It is given observations and a rig, and nothing else."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibration.single_thread import one_blas_thread
from daemon.numba_cache import prepare
from daemon.rigs import load_rig
from drivers.clock import NS_PER_S, SystemClock


@dataclass(frozen=True)
class Task:
    """A case as a worker gets it.

    Attributes:
        case: its name.
        rig: name or path.
        train: an observations CSV.
        held_out: readings of further poses, without positions.
        without: families left out of the library.
    """

    case: str
    rig: str
    train: bytes
    held_out: bytes
    without: tuple[str, ...] = ()


def answer(task: Task) -> dict[str, Any]:
    """The workflow's answer as JSON: verdict, effects, set, predictions of the held-out poses, seconds.

    A case that ends in an error is answered with verdict `failed`.
    """
    prepare()
    from calibration.effects.library import library
    from calibration.gap.workflow import find_gap
    from calibration.observations import parse_observations

    source = load_rig(task.rig)
    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    told: dict[str, Any] = {"case": task.case}
    try:
        train = parse_observations(task.train, source.rig, f"{task.case}.csv")
        held_out = parse_observations(task.held_out, source.rig, f"{task.case}-held-out.csv", positions_required=False)
        with one_blas_thread():
            gap = find_gap(
                source.rig,
                source.text,
                train,
                families=[name for name in library() if name not in task.without],
            )
        told["seconds"] = (clock.monotonic_ns() - started_ns) / NS_PER_S
        told |= gap.as_dict()
        told["before_mm"] = gap.model.geometric_mm(held_out).round(4).tolist()
        told["after_mm"] = gap.model.effects_mm(held_out).round(4).tolist()
    except Exception as error:  # noqa: BLE001 - a case that fails is a result, and hours of other cases are not lost
        told["seconds"] = (clock.monotonic_ns() - started_ns) / NS_PER_S
        told |= {"verdict": "failed", "error": str(error), "traceback": traceback.format_exc()}
    return told


def oracle(task: Task) -> dict[str, Any]:
    """What kinematics alone predict for the held-out poses, fitted to the case's twin without effects."""
    prepare()
    from calibration import pipeline
    from calibration.observations import parse_observations

    source = load_rig(task.rig)
    train = parse_observations(task.train, source.rig, f"{task.case}.csv")
    held_out = parse_observations(task.held_out, source.rig, f"{task.case}-held-out.csv", positions_required=False)
    model = pipeline.identify(source.rig, source.text, train, effects="none")
    return {"case": task.case, "oracle_mm": model.geometric_mm(held_out).round(4).tolist()}


def proposed_poses(told: Mapping[str, Any], number: int) -> list[dict[str, Any]]:
    """The first poses that an answer proposes, as a plan's rows; none where it proposes none."""
    rows = [row for experiment in told.get("experiments", ()) for row in experiment.get("poses", ())]
    return rows[:number]
