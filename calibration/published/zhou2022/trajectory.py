"""The error along one path of the tip: before, after each learner, and with everything (the paper's Fig. 12)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import get_args

import numpy as np

from calibration.model import CalibratedModel
from calibration.observations import Floats, Observations
from calibration.pipeline import train_residual
from calibration.published.zhou2022.motion import Integers
from calibration.residual.hybrid import Kind
from calibration.rig import Rig

POINTS = 200
PAPER = {"rbfn": (41.5, 33.5), "lightgbm": (41.0, 28.5), "chain": (30.5, 17.4)}  # mean and std of 200 points, mm
LEARNERS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind in PAPER)


@dataclass(frozen=True)
class Trajectory:
    """Errors along the first held-out fixes of one prism, in the order of time.

    Attributes:
        prism: whose path it is.
        rows: (m,) of the held-out data.
        in_time: False where the data have no times, and the rows are taken in their own order.
        error_mm: what was predicted with -> (m,) size of the error.
        left_out: learner -> why it was not taken and its errors are those of the kinematics.
    """

    prism: str
    rows: Integers
    in_time: bool
    error_mm: Mapping[str, Floats]
    left_out: Mapping[str, str]

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "prism": self.prism,
            "points": len(self.rows),
            "in_order_of_time": self.in_time,
            "errors": {
                name: {"mean_mm": float(error.mean()), "std_mm": float(error.std()), "error_mm": error.tolist()}
                for name, error in self.error_mm.items()
            },
            "left_out": dict(self.left_out),
        }


def tip_path(rig: Rig, held_out: Observations, distance_mm: Floats) -> tuple[str, Integers, bool]:
    """The tip's prism, its first 200 rows, and whether times put them in order.

    The tip is the farthest from the base, on average, of the prisms at the last frame that was measured.

    Args:
        rig: the rig description.
        held_out: n rows.
        distance_mm: (n,) of each from the base.
    """
    measured = np.unique(held_out.prism).tolist()
    last = max(rig.prism(name).frame for name in measured)
    tips = [name for name in measured if rig.prism(name).frame == last]
    tip = max(tips, key=lambda name: float(distance_mm[held_out.prism == name].mean()))
    rows = np.flatnonzero(held_out.prism == tip)
    time_s = held_out.extra.get("time_s", np.full(len(held_out), np.nan))[rows]
    in_time = bool(np.isfinite(time_s).all())
    if in_time:
        rows = rows[np.argsort(time_s, kind="stable")]
    return tip, rows[:POINTS], in_time


def trajectory(
    model: CalibratedModel,
    bare: CalibratedModel,
    training: Observations,
    held_out: Observations,
    *,
    seed: int,
    executor: Executor,
    progress: Callable[[float], None],
) -> Trajectory:
    """Errors along the tip's path.

    Args:
        model: with effects and residual, as `calibrate` makes it.
        bare: the same kinematics without effects or residual; gets each of the paper's learners in turn.
        training: rows that both were fitted to.
        held_out: rows of the same set-ups.
        seed: of the learners.
        executor: runs what is independent.
        progress: told the share that is done.
    """
    from_base = [model.chain.base(model.values, setup).translation_mm for setup in range(len(model.chain.setups))]
    origin = np.array(from_base)[model.chain.bind(held_out).setup]
    distance_mm = np.linalg.norm(held_out.position_mm - origin, axis=1)
    tip, rows, in_time = tip_path(model.rig, held_out, np.asarray(distance_mm))
    path = held_out.select(rows)

    def size(position_mm: Floats) -> Floats:
        return np.asarray(np.linalg.norm(path.position_mm - position_mm, axis=1))

    errors = {"before": size(model.nominal_mm(path)), "geometric": size(bare.geometric_mm(path))}
    left_out: dict[str, str] = {}
    for number, kind in enumerate(LEARNERS):
        learned = train_residual(bare, training, kind=kind, seed=seed, executor=executor)
        if learned.residual is None:
            left_out[kind] = learned.residual_reason
        errors[kind] = size(learned.predict(path).position_mm)
        progress((number + 1) / len(LEARNERS))
    errors["hybrid"] = size(model.predict(path).position_mm)
    return Trajectory(tip, rows, in_time, errors, left_out)
