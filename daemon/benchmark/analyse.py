"""Analysis of a case in a worker process, which gets only the observations and the rig."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibration.model.prediction import Predictor
from calibration.numerics.single_thread import one_blas_thread
from daemon.rig_files import load_rig
from daemon.warm_up import prepare
from drivers.clock import NS_PER_S, SystemClock


@dataclass(frozen=True)
class Task:
    """Input of a worker.

    Attributes:
        case: name of the case.
        rig: name of a shipped rig, or path of a rig file.
        train: an observations CSV.
        held_out: a CSV of readings at held-out poses, without positions.
        without: families left out of the library.
    """

    case: str
    rig: str
    train: bytes
    held_out: bytes
    without: tuple[str, ...] = ()


def answer(task: Task) -> dict[str, Any]:
    """Run the gap workflow on a case.

    Returns:
        The JSON object of the workflow, with predicted held-out positions (`before_mm`, `after_mm`) and `seconds`; a
        case that ends in an error has the verdict `failed`.
    """
    prepare()
    from calibration.effects.library import library
    from calibration.observations import parse_observations
    from calibration.pipeline.find_gap import find_gap

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
        told["before_mm"] = Predictor.of(gap.model).geometric_mm(held_out).round(4).tolist()
        told["after_mm"] = Predictor.of(gap.model).effects_mm(held_out).round(4).tolist()
    except Exception as error:  # noqa: BLE001 - a failing case is a result and must not lose hours of other cases
        told["seconds"] = (clock.monotonic_ns() - started_ns) / NS_PER_S
        told |= {"verdict": "failed", "error": str(error), "traceback": traceback.format_exc()}
    return told


def oracle(task: Task) -> dict[str, Any]:
    """Predict the held-out poses with kinematics fitted to the case's twin, which has no effects."""
    prepare()
    from calibration.observations import parse_observations
    from calibration.pipeline.calibrate import identify

    source = load_rig(task.rig)
    train = parse_observations(task.train, source.rig, f"{task.case}.csv")
    held_out = parse_observations(task.held_out, source.rig, f"{task.case}-held-out.csv", positions_required=False)
    model = identify(source.rig, source.text, train, effects="none")
    return {"case": task.case, "oracle_mm": Predictor.of(model).geometric_mm(held_out).round(4).tolist()}


def proposed_poses(told: Mapping[str, Any], number: int) -> list[dict[str, Any]]:
    """Return the first `number` poses that an answer proposes, as rows of a plan."""
    rows = [row for experiment in told.get("experiments", ()) for row in experiment.get("poses", ())]
    return rows[:number]
